"""What a campaign in the world of the quadrotor is asked to fly, as its TOML file says it."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.campaign.spec import MOST_OF_A_KIND, LinkSpec, Name, Overrides
from uavctl.config.section import LARGEST_SEED, Section
from uavctl.trial.case import AUTOPILOTS, SCENARIOS, Air, AutopilotName, Scenario

QUADROTOR = "quadrotor"
MOST_TRIALS = 100_000
Rate = Annotated[float, Meta(ge=0.01, le=1000)]


class TrialControllerSpec(Section, frozen=True, kw_only=True):
    """One that flies: a controller of ours, or the vehicle by its own position loop."""

    name: Name
    kind: Annotated[
        Literal["smpc", "own-loop"],
        Meta(description="`smpc`: ours; `own-loop`: the vehicle's own position loop on the same positions"),
    ]
    set: Annotated[Overrides, Meta(description="with `smpc`: overrides of the configuration that it is made from")] = ()
    link: Annotated[
        Literal["true", "configured"],
        Meta(description="with `smpc`: the link that it is designed for: the one it flies on, or its configuration's"),
    ] = "true"
    tuned: Annotated[
        bool,
        Meta(description="with `own-loop`: gains, delay and lead as tuned for preset `room`; else as delivered"),
    ] = False


class TrialSpec(Section, frozen=True, kw_only=True):
    """A campaign of flights of the true quadrotor: every controller in every scenario, each for the same runs."""

    name: Annotated[
        str,
        Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$", description="name of the campaign; part of its folder's name"),
    ]
    world: Annotated[
        Literal["quadrotor"], Meta(description="`quadrotor`: rigid body, rotors, wind and an autopilot's loops")
    ]
    config: Annotated[str, Meta(description="flight configuration: a preset, or a file, seen from the campaign's")]
    set: Annotated[Overrides, Meta(description="overrides of the configuration, for all")] = ()
    runs: Annotated[int, Meta(ge=1, le=MOST_TRIALS, description="flights of each cell")] = 20
    master: Annotated[
        int, Meta(ge=0, le=LARGEST_SEED, description="seed: flight i's draws come from (master, i), in every cell")
    ] = 0
    seconds: Annotated[
        float, Meta(ge=1, le=3600, description="length of a flight; a figure of eight has its own [s]")
    ] = 40.0
    from_s: Annotated[float, Meta(ge=0, le=3600, description="from when on the target is to be held [s]")] = 10.0
    scenario: Annotated[
        tuple[Scenario, ...],
        Meta(
            min_length=1,
            max_length=3,
            description="`hold`: from the start to the target, and hold it; `eight`: three times around a figure of "
            "eight, 0.76 m/s in the mean and 1.5 m/s at most; `blackout`: `hold` with 4 s without any position",
        ),
    ] = SCENARIOS
    autopilot: Annotated[
        tuple[AutopilotName, ...], Meta(min_length=1, max_length=2, description="whose behaviour the vehicle shows")
    ] = AUTOPILOTS
    rate_hz: Annotated[
        tuple[Rate, ...],
        Meta(min_length=1, max_length=MOST_OF_A_KIND, description="positions a second that the cameras give [1/s]"),
    ] = (5.0, 50.0)
    air: Annotated[
        tuple[Air, ...],
        Meta(
            min_length=1,
            max_length=3,
            description="`calm`, or 0.7 m/s of wind with `gusts` (gust_wind_mps 3) or `strong-gusts` (gust_wind_mps 8)",
        ),
    ] = ("gusts",)
    controller: Annotated[
        tuple[TrialControllerSpec, ...], Meta(min_length=1, max_length=MOST_OF_A_KIND, description="who flies")
    ]
    link: Annotated[tuple[LinkSpec, ...], Meta(min_length=1, max_length=MOST_OF_A_KIND, description="links")] = (
        LinkSpec(name="as configured"),
    )
