"""What a campaign is asked to fly, as its TOML file says it.

Every key has its unit and meaning in `Meta(description=...)`, as in the flight configuration.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.section import LARGEST_PLANT, LARGEST_SEED, Floats, Rows, Section

TRUE = "true"  # a controller that believes in the link it flies on

Kind = Literal[
    "smpc", "lqg", "packetised", "mean-qp", "governor", "worst-case-delay", "hold-last", "zero-on-loss", "pid"
]
Measured = Literal["state", "position"]
Shape = Literal["gaussian", "uniform", "heavy", "gusts"]
Name = Annotated[str, Meta(min_length=1, max_length=60, description="what it is called in tables and plots")]
Overrides = Annotated[tuple[str, ...], Meta(max_length=100)]
MOST_OF_A_KIND = 100
MOST_DESIGNS, MOST_CELLS = 200, 10_000
MOST_RUNS = 10_000_000
# Part of the result: the last bits of a product depend on how many runs it is made for.
CHUNK = 1000
MOST_STEPS_AT_ONCE = 2_000_000  # their states are held in memory


class ControllerSpec(Section, frozen=True, kw_only=True):
    """One controller."""

    name: Name
    kind: Annotated[Kind, Meta(description="what it is")]
    set: Annotated[
        Overrides, Meta(description="overrides of the configuration that it is designed from: what it believes")
    ] = ()
    link: Annotated[
        str, Meta(description="the link that it believes in: `true`, the one it flies on, or the name of a [[link]]")
    ] = TRUE
    margin: Annotated[
        float,
        Meta(
            ge=0,
            le=1000,
            description="with `packetised`, `hold-last` and `zero-on-loss`: how far plans keep from the state limits, "
            "in standard deviations of one step's disturbance; with `mean-qp` and `governor`: in those of a prediction "
            "as old as the stage",
        ),
    ] = 0.0


class LinkSpec(Section, frozen=True, kw_only=True):
    """One link."""

    name: Name
    set: Annotated[Overrides, Meta(description="overrides of the configuration's [link]")] = ()


class DisturbanceSpec(Section, frozen=True, kw_only=True):
    """One disturbance: a transform of the same standard normal draws."""

    name: Name
    kind: Annotated[
        Shape,
        Meta(
            description="`gaussian`; `uniform`; `heavy`: Student's t with 4 degrees; `gusts`: each step keeps `memory` "
            "of the last one's. All have the plant's covariance W, times scale²"
        ),
    ] = "gaussian"
    scale: Annotated[float, Meta(ge=0, le=1e6, description="factor of W's standard deviations")] = 1.0
    bias: Annotated[float, Meta(ge=-1e6, le=1e6, description="constant that is added, in standard deviations of W")] = (
        0.0
    )
    memory: Annotated[float, Meta(ge=0, lt=1, description="with `gusts`: correlation of a step with the next")] = 0.0


class PlantSpec(Section, frozen=True, kw_only=True):
    """One plant that is flown; the controllers go on believing in the configuration's."""

    name: Name
    set: Annotated[Overrides, Meta(description="overrides of the configuration's [plant]")] = ()


class TuningSpec(Section, frozen=True, kw_only=True):
    """What a user would set otherwise for some controllers on the links that they believe in."""

    controllers: Annotated[
        tuple[str, ...], Meta(min_length=1, max_length=MOST_OF_A_KIND, description="names of [[controller]]s")
    ]
    links: Annotated[
        tuple[str, ...],
        Meta(min_length=1, max_length=MOST_OF_A_KIND, description="names of [[link]]s that they believe in"),
    ]
    set: Annotated[Overrides, Meta(description="overrides of the design; they win over the controller's")] = ()
    margin: Annotated[
        Annotated[float, Meta(ge=0, le=1000)] | None,
        Meta(description="their `margin` there; if not given, the controllers' own"),
    ] = None


class CampaignSpec(Section, frozen=True, kw_only=True):
    """A campaign: every controller on every link in every disturbance with every plant, each for the same runs."""

    name: Annotated[
        str,
        Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$", description="name of the campaign; part of its folder's name"),
    ]
    config: Annotated[str, Meta(description="flight configuration: a preset, or a file, seen from the campaign's")]
    set: Annotated[Overrides, Meta(description="overrides of the configuration, for all")] = ()
    steps: Annotated[int, Meta(ge=2, le=100_000, description="steps of a run")] = 50
    runs: Annotated[int, Meta(ge=1, le=MOST_RUNS, description="runs of each cell")] = 1000
    master: Annotated[
        int, Meta(ge=0, le=LARGEST_SEED, description="seed: run i's draws come from (master, i), in every cell")
    ] = 0
    measured: Annotated[
        Measured,
        Meta(
            description="what a controller is told of a step whose position comes: `state`, all of it, exactly; or "
            "`position`, with the noise of `sim.camera.noise_std_m`, of which the flight's filter (its `[estimator]`, "
            "without a bias) makes state and covariance"
        ),
    ] = "state"
    start: Annotated[
        Floats, Meta(max_length=LARGEST_PLANT, description="state (n_x) in which every run starts; else sim.start_*")
    ] = ()
    start_box: Annotated[
        Rows,
        Meta(
            max_length=2,
            description="[lower, upper] (n_x each): each run starts at a state drawn uniformly from this box",
        ),
    ] = ()
    controller: Annotated[tuple[ControllerSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="controllers")]
    link: Annotated[tuple[LinkSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="links")] = (
        LinkSpec(name="as configured"),
    )
    disturbance: Annotated[tuple[DisturbanceSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="disturbances")] = (
        DisturbanceSpec(name="gaussian"),
    )
    plant: Annotated[tuple[PlantSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="plants")] = (
        PlantSpec(name="as modelled"),
    )
    tuning: Annotated[
        tuple[TuningSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="settings of controllers on some links")
    ] = ()
