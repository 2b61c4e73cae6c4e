"""What is flown in a trial: who flies, what, with whom, in which air and over which link. Plain and picklable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from uavctl.config import Config, load_config, parse
from uavctl.data import Vec3
from uavctl.trial.eight import CENTRE_M, eight
from uavctl.trial.own_loop import OwnTuning

Scenario = Literal["hold", "eight", "blackout"]
AutopilotName = Literal["px4", "ardupilot"]
Air = Literal["calm", "gusts", "strong-gusts"]

SCENARIOS: tuple[Scenario, ...] = ("hold", "eight", "blackout")
AUTOPILOTS: tuple[AutopilotName, ...] = ("px4", "ardupilot")
AIRS: tuple[Air, ...] = ("calm", "gusts", "strong-gusts")
WIND_MPS: Vec3 = (0.6, -0.36, 0.0)  # 0.7 m/s, wherever there are gusts
GUST_WIND_MPS: dict[Air, float] = {"calm": 0.0, "gusts": 3.0, "strong-gusts": 8.0}
BLACKOUT_S = 4.0
BLACKOUT_BEGINS_S = (1.0, 6.0)  # the way of preset `room` takes about as long
_MOMENT = 1  # child of a flight's seed that draws when a blackout begins
EIGHT_MORE_S = 2.0  # after the end of the figure of eight


@dataclass(frozen=True)
class TrialPilot:
    """Who flies: a controller of ours, or the vehicle by itself.

    Attributes:
        name: What it is called.
        config: Preset or file that it is made from; what messages call it, where there is a text.
        overrides: Of it.
        own: How the vehicle is set up that flies by its own position loop; None where ours flies.
        knows_link: Whether it is designed for the link that it meets; else for that of its configuration.
        text: TOML text that it is made from instead, for who has not the file; empty for none.
    """

    name: str
    config: str = "room"
    overrides: tuple[str, ...] = ()
    own: OwnTuning | None = None
    knows_link: bool = False
    text: str = ""

    def load(self, overrides: Sequence[str]) -> Config:
        """Its configuration with its own and further overrides.

        Raises:
            ConfigError: An override is none.
        """
        every = (*self.overrides, *overrides)
        return parse(self.text, self.config, every).config if self.text else load_config(self.config, every)


@dataclass(frozen=True)
class TrialCell:
    """Flights that differ in their seed alone.

    Attributes:
        pilot: Who flies.
        scenario: What.
        autopilot: Whose behaviour the vehicle shows.
        rate_hz: Of the cameras.
        link_name: What the link is called.
        link: Overrides that make it.
        air: Calm, or wind with gusts (`GUST_WIND_MPS`).
    """

    pilot: TrialPilot
    scenario: Scenario
    autopilot: AutopilotName
    rate_hz: float
    link_name: str
    link: tuple[str, ...]
    air: Air


def flown(cell: TrialCell, seed: int, seconds: float) -> Config:
    """The configuration that a flight meets: simulator, link and mission.

    Raises:
        ConfigError: An override is none.
    """
    wind = (0.0, 0.0, 0.0) if cell.air == "calm" else WIND_MPS
    more = [
        f"duration_s={seconds}",
        "sim.plant=quadrotor",
        f"sim.autopilot={cell.autopilot}",
        f"sim.seed={seed}",
        f"sim.camera.rate_hz={cell.rate_hz}",
        f"sim.wind.velocity_mps={list(wind)}",
        f"sim.wind.gust_wind_mps={GUST_WIND_MPS[cell.air]}",
        *cell.link,
    ]
    if cell.scenario == "blackout":
        begin = blackout_s(seed)
        more.append(f"link.blackout=[[{begin}, {begin + BLACKOUT_S}]]")
    return _with_mission(cell.pilot.load(more), cell.scenario)


def believed(cell: TrialCell) -> Config:
    """The configuration that a controller of ours is made from.

    Raises:
        ConfigError: An override is none.
    """
    overrides = (f"sim.autopilot={cell.autopilot}", *(cell.link if cell.pilot.knows_link else ()))
    return _with_mission(cell.pilot.load(overrides), cell.scenario)


def blackout_s(seed: int) -> float:
    """When a flight's blackout begins [s]: a random moment under way, the same for all who fly."""
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(_MOMENT + 1)[_MOMENT])
    return round(float(rng.uniform(*BLACKOUT_BEGINS_S)), 3)


def length_s(scenario: Scenario, seconds: float) -> float:
    """How long a flight lasts [s]: a figure of eight is flown to its end."""
    return eight().times_s[-1] + EIGHT_MORE_S if scenario == "eight" else seconds


def _with_mission(config: Config, scenario: Scenario) -> Config:
    """The configuration with the figure of eight from its centre, if that is flown."""
    if scenario != "eight":
        return config
    replace = msgspec.structs.replace
    return replace(
        config,
        mission=replace(config.mission, waypoints=(), trajectory=eight(), then="hold"),
        sim=replace(config.sim, start_position_m=CENTRE_M, start_velocity_mps=(0.0, 0.0, 0.0)),
        target=replace(config.target, position_m=CENTRE_M),
    )
