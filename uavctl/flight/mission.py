"""Mission of a flight, step by step: waypoints, a trajectory, limits that change in time. Pure.

Time counts from the first decision with a vehicle that takes setpoints, and runs on from there. That decision is at a
Δt boundary, and so is every other: a trajectory is met at its own samples only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uavctl.arrays import Array
from uavctl.frames import suggest_height_sign
from uavctl.records import Vec3, Vector
from uavctl.smpc.answer import Path, Preview
from uavctl.smpc.plant import AXES

LEADS_M = 0.5  # with a longer way than this in both horizontal axes, one of them leads
PUSHED_M = 0.3  # an axis that stops further than this outside the region moves from the start, and so it leads


@dataclass(frozen=True, eq=False)
class Waypoint:
    """A place to fly to and to stay at."""

    target: Array  # equilibrium there (n_x,)
    hold_ns: int  # time to stay, from the arrival on [ns]; the last one is held to the end
    yaw_rad: float | None = None  # on the way there and there, clockwise from north; None: that of the whole mission


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion of the plant and the plans along it, one row a Δt; after the last row it rests there."""

    states: Array  # the motion (n, n_x)
    anchors: Array  # (n, n_x): the equilibrium that a plan from this row on ends in
    path_states: Array  # (n, H, n_x): the states of that plan, as deviations from its anchor
    path_inputs: Array  # (n, H, n_u): its inputs, as deviations from what holds the plant at the anchor


@dataclass(frozen=True, eq=False)
class Fence:
    """A moving limit: the right side of a row of the state set, a line between samples, constant outside of them."""

    row: int  # index of the row
    times_ns: Array  # (n,), increasing
    values: Array  # (n,), right sides at these times


@dataclass(frozen=True, eq=False)
class RestRegion:
    """Places where the plant may rest, and the place where a state comes to rest; a box."""

    axes: tuple[int, ...]  # index (0 north, 1 east, 2 down) of each axis that the plant has
    lower: Array  # least place to rest at of each axis (n_axes,) [m]: the terminal set fits the limits there
    upper: Array  # largest
    equilibrium_map: Array  # equilibrium for each metre of each axis (n_axes, n_x)
    stop_map: Array  # place (n_axes, n_x) at which a state comes to rest by inputs that brake, as a linear map of it

    def describe_refusal(self, position_m: Vec3) -> str:
        """Return why nothing may rest at a place; empty if it may."""
        for axis, lower, upper in zip(self.axes, self.lower, self.upper, strict=True):
            if not lower <= position_m[axis] <= upper:
                hint = suggest_height_sign(AXES[axis], position_m[axis], lower, upper)
                text = f"{AXES[axis]} {position_m[axis]:g} m is outside [{lower:.2f}, {upper:.2f}] m, where it may rest"
                return f"{text}; {hint}" if hint else text
        return ""

    def find_equilibrium(self, position_m: Vec3) -> Vector:
        """Find the equilibrium (n_x,) at a place."""
        return self._make_equilibrium(np.array([position_m[axis] for axis in self.axes]))

    def find_stop(self, state: Vector) -> Vector:
        """Find the equilibrium (n_x,) that a state is braked to, inside the limits."""
        # p = S x, within the places to rest at
        return self._make_equilibrium(np.clip(self.stop_map @ np.array(state), self.lower, self.upper))

    def find_leading_target(self, state: Vector, target: Vector) -> Vector | None:
        """Find the equilibrium (n_x,) of the leading horizontal axis alone; None where only one axis has a way to go.

        The axis with the shorter way leads. The other one follows: so it is also flown alone at the end.

        Args:
            state: Where the motion begins (n_x,).
            target: Equilibrium to go to (n_x,).
        """
        stops, ends = self.stop_map @ np.array(state), self.stop_map @ np.array(target)
        begins = np.clip(stops, self.lower, self.upper)
        way, pushed = np.abs(ends - begins), np.abs(begins - stops)
        level = [i for i, axis in enumerate(self.axes) if AXES[axis] != "down"]
        if len(level) < 2 or not way[level].min() > LEADS_M:
            return None
        follows = min(level, key=lambda i: (float(pushed[i]) > PUSHED_M, -float(way[i])))
        ends[follows] = begins[follows]
        return self._make_equilibrium(ends)

    def _make_equilibrium(self, places: Array) -> Vector:
        # x = X' p
        return tuple((places @ self.equilibrium_map).tolist())


@dataclass(frozen=True, eq=False)
class Mission:
    """Mission of a flight as configured; constant."""

    waypoints: tuple[Waypoint, ...]  # at least one; a trajectory takes their place
    accept_m: float  # A waypoint is reached when the estimate is this near [m]
    position_index: tuple[int, ...]  # states that are positions
    limits: Array  # right sides of the state set's rows (m_x,)
    horizon: int  # H [steps]
    dt_ns: int  # δt [ns]
    # Places that the operator may send the vehicle to; None if the plant cannot rest everywhere
    rest_region: RestRegion | None
    trajectory: Trajectory | None = None  # the motion to follow; None to fly to the waypoints
    fences: tuple[Fence, ...] = ()  # moving limits
    land: bool = False  # whether to land at the end; else the last place is held
    lead_ns: int = 0  # time for which the first motion is that of one horizontal axis alone [ns]
    dead_ns: int = 0  # from sending an input until it begins to act; rows of the trajectory begin so much later [ns]


@dataclass(frozen=True)
class Lead:
    """The beginning of a flight's first motion."""

    at_ns: int  # when it began [ns]
    target: Vector  # where it goes to (n_x,)
    leading_target: Vector  # equilibrium (n_x,) of its leading axis alone


@dataclass(frozen=True)
class MissionState:
    """Progress of a mission."""

    start_ns: int  # its time zero [ns]
    waypoint: int = 0  # number of the waypoint flown to, from 0
    arrived_ns: int | None = None  # when that one was reached [ns]; None if it has not been
    stay: Vector | None = None  # equilibrium (n_x,) that the operator ordered instead; None on the mission
    left_ns: int | None = None  # when the mission was left for that [ns]; None on the mission
    paused_ns: int = 0  # time that a trajectory has stood still for orders [ns]; fences move on all the same
    lead: Lead | None = None  # beginning of the first motion; None before it


def advance_mission(mission: Mission, state: MissionState | None, estimate: Vector, at_ns: int) -> MissionState:
    """Advance the mission to a boundary; it begins where there was none.

    A waypoint's time runs from the arrival on, also when a gust carries the vehicle out of the circle again.

    Args:
        estimate: Estimated state at the boundary (n_x,).
        at_ns: The boundary [ns].
    """
    state = state or MissionState(start_ns=at_ns)
    if mission.trajectory is not None or state.stay is not None:
        return state
    waypoint = mission.waypoints[state.waypoint]
    index = list(mission.position_index)
    if state.arrived_ns is None:
        if not float(np.linalg.norm(np.array(estimate)[index] - waypoint.target[index])) <= mission.accept_m:
            return state
        state = replace(state, arrived_ns=at_ns)
    over = state.arrived_ns is not None and at_ns - state.arrived_ns >= waypoint.hold_ns
    if over and state.waypoint + 1 < len(mission.waypoints):
        return replace(state, waypoint=state.waypoint + 1, arrived_ns=None)
    return state


def stay_at(state: MissionState, place: Vector, at_ns: int) -> MissionState:
    """Leave the mission at a boundary for a place (n_x,), to stay there; the waypoint flown to will be reached anew."""
    left_ns = at_ns if state.left_ns is None else state.left_ns
    return replace(state, stay=place, left_ns=left_ns, arrived_ns=None)


def resume(state: MissionState, at_ns: int) -> MissionState:
    """Go on with the mission at a boundary where it was left; its own state if it was not."""
    if state.left_ns is None:
        return state
    return replace(state, stay=None, left_ns=None, paused_ns=state.paused_ns + at_ns - state.left_ns)


def lead_with_one_axis(mission: Mission, state: MissionState, estimate: Vector, at_ns: int) -> MissionState:
    """Let one horizontal axis lead where a flight's first motion begins at a boundary; once.

    A frame that is mirrored along the way to go shows nothing on that way. Off it, it is found out at once.

    Args:
        state: State at the boundary, orders taken up.
        estimate: Estimated state at the boundary (n_x,).
        at_ns: The boundary [ns].
    """
    region, follows_trajectory = mission.rest_region, mission.trajectory is not None and state.stay is None
    if state.lead is not None or region is None or follows_trajectory:
        return state
    target = find_target(mission, state, at_ns)
    leading_target = region.find_leading_target(estimate, target)
    return state if leading_target is None else replace(state, lead=Lead(at_ns, target, leading_target))


def is_led(mission: Mission, state: MissionState, at_ns: int) -> bool:
    """Whether one horizontal axis leads at a boundary."""
    lead = state.lead
    if lead is None or at_ns - lead.at_ns >= mission.lead_ns:
        return False
    return lead.target == find_target(mission, state, at_ns)


def is_over(mission: Mission, state: MissionState, at_ns: int) -> bool:
    """Whether all of the mission has been flown, the last waypoint's time too."""
    if state.stay is not None:
        return False
    trajectory = mission.trajectory
    if trajectory is not None:  # a horizon of rest was added at its end
        return _find_row(mission, state, at_ns, trajectory) >= len(trajectory.states) - 1 - mission.horizon
    last = state.waypoint + 1 == len(mission.waypoints)
    return last and state.arrived_ns is not None and at_ns - state.arrived_ns >= mission.waypoints[-1].hold_ns


def find_target(mission: Mission, state: MissionState, at_ns: int) -> Vector:
    """Find the state (n_x,) that the mission, or the operator, wants the vehicle to be in at a time."""
    if state.stay is not None:
        return state.stay
    if mission.trajectory is None:
        return tuple(mission.waypoints[state.waypoint].target.tolist())
    states = mission.trajectory.states
    since_ns = max(at_ns - state.start_ns - state.paused_ns - mission.dead_ns, 0)
    row, into_ns = divmod(since_ns, mission.dt_ns)
    if row + 1 >= len(states):
        return tuple(states[-1].tolist())
    # x = (1 - λ) x_k + λ x_k+1
    part = into_ns / mission.dt_ns
    return tuple(((1.0 - part) * states[row] + part * states[row + 1]).tolist() if part else states[row].tolist())


def make_question(mission: Mission, state: MissionState, at_ns: int) -> tuple[Array, Preview]:
    """Make the question for a plan that begins at a boundary: the target (n_x,), and the known course ahead."""
    limits = _compute_limits(mission, at_ns - state.start_ns + mission.dead_ns)
    if state.lead is not None and is_led(mission, state, at_ns):
        return np.array(state.lead.leading_target), Preview(limits=limits)
    if state.stay is not None:
        return np.array(state.stay), Preview(limits=limits)
    trajectory = mission.trajectory
    if trajectory is None:
        return mission.waypoints[state.waypoint].target, Preview(limits=limits)
    row = _find_row(mission, state, at_ns, trajectory)
    path = Path(states=trajectory.path_states[row], inputs=trajectory.path_inputs[row])
    return trajectory.anchors[row], Preview(limits=limits, path=path)


def _find_row(mission: Mission, state: MissionState, at_ns: int, trajectory: Trajectory) -> int:
    """Find the row of the trajectory at a boundary."""
    return min((at_ns - state.start_ns - state.paused_ns) // mission.dt_ns, len(trajectory.states) - 1)


def find_limits(mission: Mission, state: MissionState | None, at_ns: int) -> Array:
    """Find the right sides (m_x,) of the state rows at a time."""
    moving = None if state is None else _compute_limits(mission, at_ns - state.start_ns)
    return mission.limits if moving is None else moving[0]


def _compute_limits(mission: Mission, since_ns: int) -> Array | None:
    """Compute the right sides of the state rows in stages 0 … H (H+1, m_x); None where no fence is closer."""
    if not mission.fences:
        return None
    times_ns = since_ns + mission.dt_ns * np.arange(mission.horizon + 1, dtype=np.float64)
    limits = np.tile(mission.limits, (mission.horizon + 1, 1))
    for fence in mission.fences:
        # h_k = min(h, fence(t + k Δt))
        moving = np.interp(times_ns, fence.times_ns, fence.values)
        limits[:, fence.row] = np.minimum(limits[:, fence.row], moving)
    return None if bool((limits == mission.limits).all()) else limits


def make_hold_mission(
    target: Array,
    position_index: tuple[int, ...],
    limits: Array,
    horizon: int,
    dt_ns: int,
    rest_region: RestRegion | None,
) -> Mission:
    """Make the mission to stay at one equilibrium (n_x,)."""
    return Mission(
        waypoints=(Waypoint(target=target, hold_ns=0),),
        accept_m=np.inf,
        position_index=position_index,
        limits=limits,
        horizon=horizon,
        dt_ns=dt_ns,
        rest_region=rest_region,
    )
