"""Controllers drawn at random: design, schedule, solver, estimator and fallback, as far as there is a design."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from uavctl.config import Config, load_config
from uavctl.errors import ConfigError, DesignError
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

TRIES = 30  # draws of a design until there is one
# Presets as they are, and one with bursts: a third of the draws.
PRESETS = (
    ("room-hahn-stursberg",),
    (
        "room-hahn-stursberg",
        "link.model=gilbert-elliott",
        "link.loss=0.2",
        "link.burst_enter=0.1",
        "link.burst_leave=0.5",
        "link.burst_loss=0.8",
    ),
    ("paper",),
)


def draw_controller(rng: np.random.Generator, seed: int) -> Config:
    """A controller for which there is a design."""
    if seed % 3 == 0:
        name, *overrides = PRESETS[int(rng.integers(len(PRESETS)))]
        return load_config(name, overrides)
    for _ in range(TRIES):
        try:
            config = load_config(*_controller(rng))
            build_flight_design(config)
        except (ConfigError, DesignError):
            continue
        return config
    raise AssertionError(f"seed {seed}: no design in {TRIES} draws")


def _controller(rng: np.random.Generator) -> tuple[str, list[str]]:
    """Preset and overrides of design, solver, estimator and fallback; not all of them fit together."""
    name = str(rng.choice(["room-hahn-stursberg", "paper"], p=[0.7, 0.3]))
    horizon = int(rng.integers(7, 15))
    settings = {
        "smpc.horizon": horizon,
        "smpc.tau": int(rng.integers(2, 6)),
        "smpc.delta_x": rng.uniform(0.85, 0.97),
        "smpc.delta_u": rng.uniform(0.8, 0.95),
        "risk.allocation": rng.choice(["ellipsoid", "halfspace"]),
        "schedule.joint": rng.choice(["true", "false"]),
        "link.loss": rng.uniform(0.0, 0.35),
        "fallback.hold_s": (hold_s := rng.uniform(0.0, 3.0)),
        "fallback.blind_hold_s": 0.5 * hold_s,
        "fallback.recover_samples": int(rng.integers(1, 5)),
        "limits.slew_mps3": rng.uniform(3.0, 50.0),
        "source.rate_hz": rng.choice([0.0, 5.0]) if name == "room-hahn-stursberg" else 0.0,
    }
    # The search solves many problems: of two axes and short horizons only.
    rules = ["fixed", "list", "greedy", *(["search"] if name == "paper" and horizon < 10 else [])]
    rule = str(rng.choice(rules))
    if rule in ("fixed", "list"):
        delays = rng.integers(3, 7)
        settings["schedule.delays"] = (
            delays if rule == "fixed" else [int(delays)] * (horizon - 2) + [int(delays) + 1] * 2
        )
    else:
        settings["schedule.rule"] = rule
        width = 9 if name == "room-hahn-stursberg" else 4
        settings["schedule.search_states"] = [[0.0] * width, [0.5] + [0.0] * (width - 1)]
    settings |= _believed_link(rng)
    method = str(rng.choice(["exact", "printed"], p=[0.8, 0.2]))
    settings["solver.method"] = method
    settings["risk.estimate"] = "exact" if method == "printed" else rng.choice(["exact", "innovations"])
    if name == "room-hahn-stursberg" and method == "exact" and rng.uniform() < 0.3:
        settings |= {"schedule.late": int(rng.integers(1, 3)), "link.delay_s": rng.uniform(0.0, 0.3)}
    if name == "room-hahn-stursberg" and rng.uniform() < 0.4:
        settings |= {"estimator.bias_drift": 0.0, "estimator.bias_max": 0.0}
    if name == "room-hahn-stursberg" and rng.uniform() < 0.3:
        settings |= {"plant.drag_1ps": [float(rng.uniform(0.05, 0.4))] * 3, "plant.lag_s": [0.25, 0.25, 0.3]}
    return name, [f"{key}={value}" for key, value in settings.items()]


def _believed_link(rng: np.random.Generator) -> dict[str, object]:
    """What the design counts on."""
    model = str(rng.choice(["bernoulli", "known ahead", "gilbert-elliott", "empirical", "trace"]))
    if model == "bernoulli":
        return {}
    if model == "known ahead":
        return {"link.probability": [float(p) for p in rng.uniform(0.6, 1.0, 4)]}
    more: dict[str, object] = {"link.model": model}
    if model == "gilbert-elliott":
        more |= {"link.burst_enter": rng.uniform(0.02, 0.1), "link.burst_leave": rng.uniform(0.4, 0.9)}
    elif model == "empirical":
        more["link.gaps"] = [0.7, 0.2, 0.07, 0.03]
    else:
        delays = np.where(rng.uniform(size=50) < 0.2, math.inf, rng.uniform(0.005, 0.03, 50))
        more["link.trace_s"] = [float(delay) for delay in delays]
        more["link.delay_s"] = 0.03
    return more


@lru_cache(maxsize=2)
def prepare_config(config: Config) -> Prepared:
    """What flies with a drawn configuration."""
    return prepare(config, build_flight_design(config))


def is_mission_feasible(config: Config) -> bool:
    """Whether the mission can be flown with this design: there is rest at its places."""
    try:
        prepare_config(config)
    except DesignError:
        return False
    return True
