"""Records of the processes of a fleet: the sender of all positions, and the coordinator of the cells.

Names, units and times are those of `uavctl.records`.
"""

from __future__ import annotations

from uavctl.records import CellMessage, CellReport, Conduct, Record, Vec3

SENDER_VERSION = 2  # of a sender's records; 1 had the positions sent alone, and no header
COORDINATOR_VERSION = 2  # of a coordinator's records; 1 had the cycles alone, and no header


class ScheduledVehicle(Record, frozen=True, kw_only=True):
    """Constants of one vehicle for the schedule."""

    kind: int  # row of its costs
    wait_std_m: float  # deviation of its position at the longest wait
    quantile: float  # of the allowed risk
    lower_m: tuple[float, ...]  # limits of its position, one an axis; infinite where open
    upper_m: tuple[float, ...]


class SenderHeader(Record, frozen=True, kw_only=True):
    """Constants of a sender: with the offers and reports, they give each of its choices."""

    version: int = SENDER_VERSION
    zero_utc_ns: int  # UTC of time 0 of the recording's clock [ns since 1970]
    start_ns: int
    names: tuple[str, ...]  # of the vehicles
    schedule: str
    slot_ns: int  # time of a position on the channel
    max_wait_slots: int
    loss: float  # probability that a message is lost
    feedback_ns: int  # longest time to a report; 0: none comes
    spacing_m: float  # smallest distance of two vehicles
    costs: tuple[tuple[float, ...], ...]  # of an age of 0, 1 … slots, one row a kind of vehicle
    vehicles: tuple[ScheduledVehicle, ...]
    versions: dict[str, str]  # of code, libraries and arithmetic, which decide the last bits
    cpu: str


class OfferedPosition(Record, frozen=True, kw_only=True):
    """Position of a vehicle, newer than the one before, that may be sent."""

    vehicle: str
    captured_ns: int
    position_m: Vec3


class ReportedPosition(Record, frozen=True, kw_only=True):
    """Report of a vehicle about its newest position."""

    vehicle: str
    captured_ns: int


class ScheduleWeights(Record, frozen=True, kw_only=True):
    """Weights of the vehicles from now on, by their distances to limits and to each other."""

    weights: dict[str, float]


class SentPosition(Record, frozen=True, kw_only=True):
    """Position that the sender put on the channel."""

    vehicle: str
    captured_ns: int
    bytes: int
    ages_s: dict[str, float]  # believed age of each vehicle's newest position before this message


class CoordinatorHeader(Record, frozen=True, kw_only=True):
    """Constants of a coordinator: with the reports, they give each of its cells."""

    version: int = COORDINATOR_VERSION
    zero_utc_ns: int  # UTC of time 0 of the recording's clock [ns since 1970]
    names: tuple[str, ...]  # of the vehicles
    parameters: dict[str, object]  # `uavctl.fleet.coordinator.CellParameters`
    versions: dict[str, str]  # of code, libraries and arithmetic, which decide the last bits
    cpu: str


class TakenReport(Record, frozen=True, kw_only=True):
    """Report that the next cycle took up."""

    vehicle: str
    report: CellReport


class IssuedCell(Record, frozen=True, kw_only=True):
    """Cell that the next cycle issued."""

    vehicle: str
    cell: CellMessage


class VehicleCycle(Record, frozen=True, kw_only=True):
    """State of a vehicle in a cycle."""

    report_age_s: float  # since the step of its newest report
    conduct: Conduct
    position_m: Vec3  # as reported
    goal_m: Vec3  # place that its mission, or the operator, wants it at
    guide_m: Vec3  # place to which its newest cell leads it: its goal, or a way around others
    in_use: int  # number of its cell; 0 without one
    decided: int  # number of the newest cell that it took or refused
    newest: int  # number of its newest cell
    wait: str  # why it was issued none; empty if it was
    land: bool  # whether it is ordered to land
    nearest: str  # vehicle whose claim is nearest to its own; empty without one
    gap: float | None  # of these claims over the distance to keep, the least of all stages; apart: at least 1


class CoordinatorCycle(Record, frozen=True, kw_only=True):
    """A cycle of the coordinator."""

    at_ns: int
    step: int
    vehicles: dict[str, VehicleCycle]
