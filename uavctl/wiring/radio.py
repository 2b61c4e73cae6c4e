"""Composition of a sender for several vehicles from `[radio]`: slots, longest wait, link, and values of messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from scipy.linalg import block_diag

from uavctl.arrays import SECOND_NS, Array
from uavctl.config.checks import get_position_limits_m
from uavctl.config.document import ConfigProblem, Section
from uavctl.config.types import Config
from uavctl.fleet_records import ScheduledVehicle
from uavctl.records import Vec3
from uavctl.schedule.ages import compute_periodic_tail
from uavctl.schedule.channel import TIMESYNC_PAYLOAD_BYTES, Budget, compute_frame_bytes
from uavctl.schedule.scheduler import ScheduleName, Scheduler
from uavctl.schedule.value import compute_age_costs, compute_message_values, compute_weight, predict_covariances
from uavctl.smpc.estimate import add_bias
from uavctl.wiring.controller import build_plant, compute_settled_covariance
from uavctl.wiring.link import build_ages
from uavctl.wiring.rest import build_weights

# An adaptive schedule may let a vehicle wait for two rounds: with less it is hardly free, with more the design, which
# counts on the longest wait, has larger margins.
ADAPTIVE_ROUNDS = 2
MAX_AGE_S = 5.0  # larger ages cost as this one; a vehicle lands earlier
# A daemon asks for the time each 0.95 s; in 8 slots of positions there is at most one answer.
ANSWER_PERIOD_NS, ANSWER_SLOTS = 900_000_000, 8
_TAIL_ROUNDS = 400  # rounds of the mean age's sum; the rest is below 1e-15 up to a loss of 0.9


class RadioConfig(Section, frozen=True, kw_only=True):
    """The channel that carries the positions of all vehicles of a fleet."""

    # A quicker channel needs no schedule; the value of a message is computed for each slot of five seconds.
    bytes_per_s: Annotated[float, Meta(gt=0.0, le=100_000.0)] | None = None  # on the wire; 57,600 baud are 5,760
    messages_per_s: Annotated[float, Meta(gt=0.0, le=2000.0)] | None = None
    rate_hz: Annotated[float, Meta(gt=0.0, le=1000.0)] = (
        50.0  # positions a second that the cameras give of each vehicle
    )
    schedule: ScheduleName = "value"
    max_wait_s: Annotated[float, Meta(gt=0.0, le=60.0)] | None = None  # None: one or two rounds
    loss: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0  # probability that a message is lost
    feedback_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0  # longest time to a vehicle's report; 0: none comes
    signed: bool = False  # messages carry a signature

    @property
    def has_budget(self) -> bool:
        """Whether there is a channel for all vehicles."""
        return self.bytes_per_s is not None or self.messages_per_s is not None


class RadioLoad(NamedTuple):
    """Ages of the vehicles with some number of them."""

    vehicles: int
    wait_s: float  # longest time between two messages to a vehicle
    mean_age_s: float  # of a position in round-robin, without the times on its way
    silence_probability: float  # P(a >= H), the largest of all configurations; then a vehicle flies its fallback
    is_carried: bool  # the risk beyond age H leaves some for the plans, for each configuration


def make_budget(radio: RadioConfig) -> Budget:
    """Return the budget of the channel."""
    return Budget(radio.messages_per_s, radio.bytes_per_s)


def compute_slot_ns(radio: RadioConfig) -> int:
    """Return the time of one position on the channel [ns]."""
    return make_budget(radio).compute_slot_ns(compute_frame_bytes(signed=radio.signed))


def compute_answer_period_ns(radio: RadioConfig, count: int) -> int:
    """Return the least time between two answers to TIMESYNC on the channel [ns]."""
    return max(ANSWER_PERIOD_NS // count, ANSWER_SLOTS * compute_slot_ns(radio))


def compute_slots_s(radio: RadioConfig, count: int, slots: int) -> float:
    """Return the longest time of so many positions on the channel [s], with the answers to TIMESYNC among them."""
    length_bytes = compute_frame_bytes(signed=radio.signed, payload_bytes=TIMESYNC_PAYLOAD_BYTES)
    answer_ns, period_ns = make_budget(radio).compute_slot_ns(length_bytes), compute_answer_period_ns(radio, count)
    # W = M slot + (floor(W / period) + 1) answer; the period is 8 answers or more, so the iteration ends
    positions_ns, wait_ns = slots * compute_slot_ns(radio), 0
    while wait_ns != (next_ns := positions_ns + (wait_ns // period_ns + 1) * answer_ns):
        wait_ns = next_ns
    return wait_ns / SECOND_NS


def compute_max_wait_slots(radio: RadioConfig, count: int) -> int:
    """Return the longest wait of a vehicle, in slots; too few for all of them if `max_wait_s` is too short."""
    if radio.max_wait_s is not None:
        slots = int(radio.max_wait_s * SECOND_NS / compute_slot_ns(radio))
        while slots and compute_slots_s(radio, count, slots) > radio.max_wait_s + 1e-9:
            slots -= 1
        return slots
    return count * (1 if radio.schedule == "round-robin" else ADAPTIVE_ROUNDS)


def compute_link_wait_s(radio: RadioConfig, count: int) -> float:
    """Return the longest time between two messages to a vehicle [s], for the link model.

    The channel is never idle while a round takes longer than the cameras' period. Else it may have nothing to send,
    and a vehicle waits for its next position in addition.
    """
    slot_s, period_s = compute_slot_ns(radio) / SECOND_NS, 1.0 / radio.rate_hz
    wait_s = compute_slots_s(radio, count, compute_max_wait_slots(radio, count))
    return wait_s if count * slot_s > period_s else wait_s + period_s


def find_radio_problems(radio: RadioConfig, count: int) -> list[ConfigProblem]:
    """Return what is wrong with a radio for `count` vehicles."""
    if radio == RadioConfig():
        return []
    if not radio.has_budget:
        return [ConfigProblem("radio", "has no budget", "give bytes_per_s or messages_per_s")]
    slot_s = compute_slot_ns(radio) / SECOND_NS
    if compute_max_wait_slots(radio, count) < count:
        round_s = math.ceil(1e4 * compute_slots_s(radio, count, count)) * 1e-4
        return [
            ConfigProblem(
                "radio.max_wait_s",
                f"{radio.max_wait_s:g} s is too short: {count} messages of {slot_s:.4g} s take up to {round_s:.4f} s "
                "with answers to TIMESYNC",
                f"give {round_s:.4f} or more, a larger budget, or fewer vehicles",
            )
        ]
    return []


def make_link_overrides(radio: RadioConfig, count: int) -> list[str]:
    """Return the overrides by which a vehicle is designed for the radio."""
    return [
        *(["source.report=true"] if radio.feedback_s else []),
        'link.model="scheduled"',
        f"link.loss={radio.loss!r}",
        f"link.wait_s={compute_link_wait_s(radio, count)!r}",
        f"source.rate_hz={radio.rate_hz!r}",
    ]


def compute_loads(radio: RadioConfig, configs: Sequence[Config], max_vehicles: int) -> list[RadioLoad]:
    """Return the ages with 1 … `max_vehicles` vehicles, as far as the longest wait has slots for them.

    A further vehicle counts as one of the given configurations, whose links are replaced.
    """
    loads: list[RadioLoad] = []
    if not radio.has_budget:
        return loads
    slot_s = compute_slot_ns(radio) / SECOND_NS
    for count in range(1, max_vehicles + 1):
        if find_radio_problems(radio, count):
            break
        wait_s = compute_link_wait_s(radio, count)
        probabilities, is_carried = [], True
        for config in configs:
            link = msgspec.structs.replace(config.link, model="scheduled", loss=radio.loss, wait_s=wait_s)
            source = msgspec.structs.replace(config.source, rate_hz=radio.rate_hz)
            changed = msgspec.structs.replace(config, link=link, source=source)
            probability = build_ages(changed).outage(config.smpc.horizon)
            # Σ_{t<=H} π_t ε_t <= 1 - δ_x - P(a >= H)
            is_carried &= probability < 1.0 - config.smpc.delta_x
            probabilities.append(probability)
        # E a = Σ_{n>0} P(a >= n)
        tail = compute_periodic_tail(range(count), 0, radio.loss, _TAIL_ROUNDS * count)
        loads.append(RadioLoad(count, wait_s, float(tail[1:].sum()) * slot_s, max(probabilities), is_carried))
    return loads


def compute_vehicle_costs(config: Config, slot_s: float) -> tuple[Array, Array]:
    """Return the cost of a vehicle's age, and the deviation of its position [m], at ages of 0 … slots (n,)."""
    plant = build_plant(config)
    cov, state_cost = compute_settled_covariance(config, plant), build_weights(config.cost, plant)[0]
    if config.estimator.bias_drift:
        plant = add_bias(plant, config.estimator.bias_drift, force=config.estimator.inertial_std_mps2 > 0.0)
        state_cost = block_diag(state_cost, np.zeros((plant.n_u, plant.n_u)))
    size = plant.n_x
    covs = predict_covariances(plant, cov[:size, :size], slot_s, 2 + math.ceil(MAX_AGE_S / slot_s))
    index = list(plant.position_index)
    return compute_age_costs(covs, state_cost[:size, :size]), np.sqrt(covs[:, index, index].max(axis=1))


def compute_fleet_costs(configs: Sequence[Config], radio: RadioConfig) -> list[tuple[Array, Array]]:
    """Return `compute_vehicle_costs` of each vehicle, computed once for vehicles of one kind."""
    replace, slot_s = msgspec.structs.replace, compute_slot_ns(radio) / SECOND_NS
    known, results = list[tuple[Config, tuple[Array, Array]]](), []
    for config in configs:
        # What differs between vehicles of one kind, and has no part in the costs
        daemon = replace(config.daemon, vehicle="", mocap="")
        first = configs[0]
        kind = replace(
            config, daemon=daemon, security=first.security, sets=first.sets, target=first.target, sim=first.sim
        )
        costs = next((costs for other, costs in known if other == kind), None)
        if costs is None:
            costs = compute_vehicle_costs(config, slot_s)
            known.append((kind, costs))
        results.append(costs)
    return results


def compute_quantile(config: Config) -> float:
    """Return κ of the allowed risk, Φ⁻¹(δ_x)."""
    return NormalDist().inv_cdf(config.smpc.delta_x)


class ScheduleParameters(msgspec.Struct, frozen=True, kw_only=True):
    """Constants of the schedule of a radio for some vehicles."""

    schedule: ScheduleName
    slot_ns: int  # time of a position on the channel
    max_wait_slots: int
    loss: float
    feedback_ns: int  # longest time to a report; 0: none comes
    costs: tuple[tuple[float, ...], ...]  # of an age of 0, 1 … slots, one row a kind of vehicle
    vehicles: tuple[ScheduledVehicle, ...]


def build_schedule_parameters(configs: Sequence[Config], radio: RadioConfig) -> ScheduleParameters:
    """Build the constants of a radio's schedule.

    Raises:
        DesignError: A plant is not valid.
    """
    max_wait_slots, kinds, vehicles = compute_max_wait_slots(radio, len(configs)), list[Array](), []
    for config, (costs, stds_m) in zip(configs, compute_fleet_costs(configs, radio), strict=True):
        kind = next((number for number, known in enumerate(kinds) if known is costs), len(kinds))
        kinds += [costs] if kind == len(kinds) else []
        lower_m, upper_m = zip(*get_position_limits_m(config).values(), strict=True)
        vehicles.append(
            ScheduledVehicle(
                kind=kind,
                wait_std_m=float(stds_m[min(max_wait_slots, len(stds_m) - 1)]),
                quantile=compute_quantile(config),
                lower_m=lower_m,
                upper_m=upper_m,
            )
        )
    return ScheduleParameters(
        schedule=radio.schedule,
        slot_ns=compute_slot_ns(radio),
        max_wait_slots=max_wait_slots,
        loss=radio.loss,
        feedback_ns=round(radio.feedback_s * SECOND_NS),
        costs=tuple(tuple(row.tolist()) for row in kinds),
        vehicles=tuple(vehicles),
    )


class RadioSchedule:
    """Schedule of a radio for some vehicles, with the weights of their places.

    Attributes:
        scheduler: Chooses the vehicle of each message.

    Args:
        start_ns: Time of the start [ns].

    Raises:
        DesignError: The longest wait has no slot for each vehicle.
    """

    def __init__(self, parameters: ScheduleParameters, start_ns: int) -> None:
        self._vehicles = parameters.vehicles
        self._limits_m = [(np.array(vehicle.lower_m), np.array(vehicle.upper_m)) for vehicle in parameters.vehicles]
        values = [compute_message_values(np.array(costs), parameters.loss) for costs in parameters.costs]
        self.scheduler = Scheduler(
            parameters.schedule,
            np.array([values[vehicle.kind] for vehicle in parameters.vehicles]),
            slot_ns=parameters.slot_ns,
            max_wait_slots=parameters.max_wait_slots,
            loss=parameters.loss,
            feedback_delay_ns=parameters.feedback_ns,
            start_ns=start_ns,
        )

    def update_weights(self, positions_m: Array, half_gaps_m: Array) -> None:
        """Set w_i by the distance to the nearest limit, and half of the free distance to another vehicle.

        Args:
            positions_m: Newest position of each vehicle (N, 3), infinite where there is none.
            half_gaps_m: Half of the free distance to the nearest other vehicle (N,).
        """
        for i in np.flatnonzero(np.isfinite(positions_m[:, 0])).tolist():
            vehicle, (lower_m, upper_m) = self._vehicles[i], self._limits_m[i]
            columns = positions_m[i, : len(lower_m)]
            wall_m = min((columns - lower_m).min(), (upper_m - columns).min())
            distance_m = min(float(wall_m), float(half_gaps_m[i]))
            self.scheduler.vehicles[i].weight = compute_weight(distance_m, vehicle.wait_std_m, vehicle.quantile)


def compute_half_gaps_m(positions_m: Array, spacing_m: float) -> Array:
    """Return half of the free horizontal distance of each vehicle to the nearest other one (N,) [m].

    Height does not count, as in the vehicles' limits.

    Args:
        positions_m: Newest positions (N, 3), infinite where there is none.
        spacing_m: Smallest distance of two vehicles [m].
    """
    half_gaps_m = np.full(len(positions_m), np.inf)
    known = np.flatnonzero(np.isfinite(positions_m[:, 0]))
    horizontal_m = positions_m[known, :2]
    gaps_m = np.linalg.norm(horizontal_m[:, None] - horizontal_m[None, :], axis=2) - spacing_m
    np.fill_diagonal(gaps_m, np.inf)
    half_gaps_m[known] = 0.5 * gaps_m.min(axis=1, initial=np.inf)
    return half_gaps_m


class PlacedSchedule(RadioSchedule):
    """Schedule that knows the newest position of each vehicle.

    Args:
        spacing_m: Smallest distance of two vehicles [m].
    """

    def __init__(self, parameters: ScheduleParameters, spacing_m: float, start_ns: int) -> None:
        super().__init__(parameters, start_ns)
        self._spacing_m, self._positions_m = spacing_m, np.full((len(parameters.vehicles), 3), np.inf)

    @property
    def weights(self) -> list[float]:
        """Weights of the vehicles."""
        return [vehicle.weight for vehicle in self.scheduler.vehicles]

    def add_position(self, number: int, captured_ns: int, position_m: Vec3) -> bool:
        """Note a vehicle's newest position; return False for one that is not newer."""
        is_newer = self.scheduler.add_position(number, captured_ns)
        if is_newer:
            self._positions_m[number] = position_m
        return is_newer

    def update_placed_weights(self) -> None:
        """Set the weights by the newest positions."""
        self.update_weights(self._positions_m, compute_half_gaps_m(self._positions_m, self._spacing_m))
