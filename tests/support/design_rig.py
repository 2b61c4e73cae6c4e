"""The presets' plants and specifications, read from TOML without the project's own reader."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np

from uavctl.smpc.hahn_stursberg.design import DesignSpec
from uavctl.smpc.link import bernoulli
from uavctl.smpc.plant import Plant, drag_lag
from uavctl.smpc.sets import Polytope


def preset(name: str) -> dict[str, Any]:
    return tomllib.loads(files("uavctl").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8"))


def paper_plant() -> Plant:
    table = preset("paper")["plant"]
    return Plant(
        a=np.array(table["a"]),
        b=np.array(table["b"]),
        e=np.array(table["e"]),
        w=np.array(table["w"]),
        dt_s=table["dt_s"],
        axes=tuple(table["axes"]),
        position_index=tuple(table["position_index"]),
        velocity_index=tuple(table["velocity_index"]),
        accel_per_input=np.array(table["accel_per_input"]),
    )


def room_plant() -> Plant:
    table = preset("room-hahn-stursberg")["plant"]
    return drag_lag(
        drag_1ps=table["drag_1ps"],
        lag_s=table["lag_s"],
        gain=table["gain"],
        wind_std_mps2=table["wind_std_mps2"],
        dt_s=table["dt_s"],
        axes=tuple(table["axes"]),
    )


def spec(name: str, **changes: Any) -> DesignSpec:
    table = preset(name)
    plant = paper_plant() if name == "paper" else room_plant()
    sets, smpc = table["sets"], table["smpc"]
    given = DesignSpec(
        plant=plant,
        state_set=Polytope.from_box(sets["state_lower"], sets["state_upper"]),
        input_set=Polytope.from_box(sets["input_lower"], sets["input_upper"]),
        q_x=np.diag(np.array(table["cost"]["state"])),
        q_u=np.diag(np.array(table["cost"]["input"])),
        horizon=smpc["horizon"],
        tau=smpc["tau"],
        delta_x=smpc["delta_x"],
        delta_u=smpc["delta_u"],
        delta_tau=smpc["delta_tau"],
        k_tau=np.array(smpc["k_tau"]),
        link=bernoulli(np.array([1.0 - table["link"]["loss"]])),
        target_m=tuple(table["target"]["position_m"]),
        rule="fixed",
        delays=table["schedule"]["delays"],
        gamma_max=0.985,
        search_states=np.zeros((0, plant.n_x)),
        allocation="ellipsoid",
        slack_linear=smpc["slack_linear"],
        slack_quadratic=smpc["slack_quadratic"],
        offset_weight=smpc["offset_weight"],
        terminal_weight=1e5,
        max_iterations=100,
    )
    return replace(given, **changes)


def one_axis(plant: Plant) -> Plant:
    """The north axis of the paper's plant."""
    return Plant(
        a=plant.a[:2, :2],
        b=plant.b[:2, :1],
        e=plant.e[:2, :1],
        w=plant.w[:1, :1],
        dt_s=plant.dt_s,
        axes=("north",),
        position_index=(0,),
        velocity_index=(1,),
        accel_per_input=plant.accel_per_input[:1],
    )
