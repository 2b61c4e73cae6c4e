"""Mission of a flight, step by step: waypoints, a trajectory, limits that change in time. Pure.

Time counts from the first decision with a vehicle that takes setpoints, and runs on from there. That decision is at a
Δt boundary, and so is every other: a trajectory is met at its own samples only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from uavctl.frames import suggest_height_sign
from uavctl.records import Vec3, Vector
from uavctl.smpc.answer import Path, Preview
from uavctl.smpc.plant import AXES, Plant

Array = NDArray[np.float64]

LEADS_M = 0.5  # of way in each of two horizontal axes: one of them leads
PUSHED_M = 0.3  # by more than this an axis that may not rest where it is moves from the start, and so it leads


@dataclass(frozen=True, eq=False)
class Waypoint:
    """A place to fly to and to stay at."""

    target: Array  # equilibrium there (n_x,)
    hold_ns: int  # time to stay, from the arrival on [ns]; the last one is held to the end


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
class Room:
    """Places where the plant may rest, and the place where a state comes to rest."""

    axes: tuple[int, ...]  # index (0 north, 1 east, 2 down) of each axis that the plant has
    lower: Array  # least place to rest at of each axis (n_axes,) [m]: the terminal set fits the limits there
    upper: Array  # largest
    rest: Array  # equilibrium for each metre of each axis (n_axes, n_x)
    stop: Array  # place (n_axes, n_x) at which a state comes to rest by inputs that brake, as a linear map of it

    def refusal(self, position_m: Vec3) -> str:
        """Return why nothing may rest at a place; empty if it may."""
        for axis, lower, upper in zip(self.axes, self.lower, self.upper, strict=True):
            if not lower <= position_m[axis] <= upper:
                hint = suggest_height_sign(AXES[axis], position_m[axis], lower, upper)
                text = f"{AXES[axis]} {position_m[axis]:g} m is outside [{lower:.2f}, {upper:.2f}] m, where it may rest"
                return f"{text}; {hint}" if hint else text
        return ""

    def at(self, position_m: Vec3) -> Vector:
        """The equilibrium (n_x,) at a place."""
        return self._equilibrium(np.array([position_m[axis] for axis in self.axes]))

    def stopped(self, state: Vector) -> Vector:
        """The equilibrium (n_x,) that a state is braked to, inside the limits."""
        return self._equilibrium(np.clip(self.stop @ np.array(state), self.lower, self.upper))

    def first(self, state: Vector, target: Vector) -> Vector | None:
        """The equilibrium (n_x,) without the longer horizontal way; None where there are not two of them to go.

        The longer one follows: so it is also flown alone at the end, where the other one has arrived.

        Args:
            state: Where the motion begins (n_x,).
            target: Equilibrium to go to (n_x,).
        """
        stops, ends = self.stop @ np.array(state), self.stop @ np.array(target)
        begins = np.clip(stops, self.lower, self.upper)
        way, pushed = np.abs(ends - begins), np.abs(begins - stops)
        level = [i for i, axis in enumerate(self.axes) if AXES[axis] != "down"]
        if len(level) < 2 or not way[level].min() > LEADS_M:
            return None
        follows = min(level, key=lambda i: (float(pushed[i]) > PUSHED_M, -float(way[i])))
        ends[follows] = begins[follows]
        return self._equilibrium(ends)

    def _equilibrium(self, places: Array) -> Vector:
        return tuple((places @ self.rest).tolist())


@dataclass(frozen=True, eq=False)
class Mission:
    """Mission of a flight as configured; constant."""

    waypoints: tuple[Waypoint, ...]  # at least one; a trajectory takes their place
    accept_m: float  # A waypoint is reached when the estimate is this near [m]
    position_index: tuple[int, ...]  # states that are positions
    limits: Array  # right sides of the state set's rows (m_x,)
    horizon: int  # H [steps]
    dt_ns: int  # δt [ns]
    room: Room | None  # places that the operator may send the vehicle to; None if the plant cannot rest everywhere
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
    first: Vector  # equilibrium (n_x,) of its leading axis alone


@dataclass(frozen=True)
class MissionState:
    """Progress of a mission."""

    start_ns: int  # its time zero [ns]
    waypoint: int = 0  # number of the waypoint flown to, from 0
    arrived_ns: int | None = None  # when that one was reached [ns]; None if it has not been
    stay: Vector | None = None  # equilibrium (n_x,) that the operator ordered instead; None on the mission
    left_ns: int | None = None  # when the mission was left for that [ns]; None on the mission
    paused_ns: int = 0  # time that a trajectory has stood still for orders [ns]; fences move on all the same
    led: Lead | None = None  # beginning of the first motion; None before it


def advance(mission: Mission, state: MissionState | None, estimate: Vector, at_ns: int) -> MissionState:
    """The mission at a boundary; it begins where there was none.

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


def stay(state: MissionState, place: Vector, at_ns: int) -> MissionState:
    """Leave the mission at a boundary for a place (n_x,), to stay there; the waypoint flown to will be reached anew."""
    left_ns = at_ns if state.left_ns is None else state.left_ns
    return replace(state, stay=place, left_ns=left_ns, arrived_ns=None)


def resume(state: MissionState, at_ns: int) -> MissionState:
    """Go on with the mission at a boundary where it was left; its own state if it was not."""
    if state.left_ns is None:
        return state
    return replace(state, stay=None, left_ns=None, paused_ns=state.paused_ns + at_ns - state.left_ns)


def lead(mission: Mission, state: MissionState, estimate: Vector, at_ns: int) -> MissionState:
    """Let one horizontal axis lead where a flight's first motion begins at a boundary; once.

    A frame that is mirrored along the way to go shows nothing on that way. Off it, it is found out at once.

    Args:
        state: State at the boundary, orders taken up.
        estimate: Estimated state at the boundary (n_x,).
        at_ns: The boundary [ns].
    """
    if state.led is not None or mission.room is None or (mission.trajectory is not None and state.stay is None):
        return state
    target = wanted(mission, state, at_ns)
    first = mission.room.first(estimate, target)
    return state if first is None else replace(state, led=Lead(at_ns, target, first))


def over(mission: Mission, state: MissionState, at_ns: int) -> bool:
    """Whether all of the mission has been flown, the last waypoint's time too."""
    if state.stay is not None:
        return False
    motion = mission.trajectory
    if motion is not None:  # a horizon of rest was added at its end
        return _row(mission, state, at_ns, motion) >= len(motion.states) - 1 - mission.horizon
    last = state.waypoint + 1 == len(mission.waypoints)
    return last and state.arrived_ns is not None and at_ns - state.arrived_ns >= mission.waypoints[-1].hold_ns


def wanted(mission: Mission, state: MissionState, at_ns: int) -> Vector:
    """State (n_x,) that the mission, or the operator, wants the vehicle to be in at a time."""
    if state.stay is not None:
        return state.stay
    if mission.trajectory is None:
        return tuple(mission.waypoints[state.waypoint].target.tolist())
    states = mission.trajectory.states
    since_ns = max(at_ns - state.start_ns - state.paused_ns - mission.dead_ns, 0)
    row, into_ns = divmod(since_ns, mission.dt_ns)
    if row + 1 >= len(states):
        return tuple(states[-1].tolist())
    part = into_ns / mission.dt_ns
    return tuple(((1.0 - part) * states[row] + part * states[row + 1]).tolist() if part else states[row].tolist())


def ask_for(mission: Mission, state: MissionState, at_ns: int) -> tuple[Array, Preview]:
    """Question for a plan that begins at a boundary: the target (n_x,), and what is known ahead."""
    limits = _limits(mission, at_ns - state.start_ns + mission.dead_ns)
    led = state.led
    if led is not None and at_ns - led.at_ns < mission.lead_ns and led.target == wanted(mission, state, at_ns):
        return np.array(led.first), Preview(limits=limits)
    if state.stay is not None:
        return np.array(state.stay), Preview(limits=limits)
    motion = mission.trajectory
    if motion is None:
        return mission.waypoints[state.waypoint].target, Preview(limits=limits)
    row = _row(mission, state, at_ns, motion)
    path = Path(states=motion.path_states[row], inputs=motion.path_inputs[row])
    return motion.anchors[row], Preview(limits=limits, path=path)


def _row(mission: Mission, state: MissionState, at_ns: int, motion: Trajectory) -> int:
    """Row of the trajectory at a boundary."""
    return min((at_ns - state.start_ns - state.paused_ns) // mission.dt_ns, len(motion.states) - 1)


def _limits(mission: Mission, since_ns: int) -> Array | None:
    """Right sides of the state rows in stages 0 … H (H+1, m_x); None where no fence is closer than they are."""
    if not mission.fences:
        return None
    times_ns = since_ns + mission.dt_ns * np.arange(mission.horizon + 1, dtype=np.float64)
    limits = np.tile(mission.limits, (mission.horizon + 1, 1))
    for fence in mission.fences:
        moving = np.interp(times_ns, fence.times_ns, fence.values)
        limits[:, fence.row] = np.minimum(limits[:, fence.row], moving)
    return None if bool((limits == mission.limits).all()) else limits


def hold(
    target: Array, position_index: tuple[int, ...], limits: Array, horizon: int, dt_ns: int, room: Room | None
) -> Mission:
    """The mission to stay at one equilibrium (n_x,)."""
    return Mission(
        waypoints=(Waypoint(target=target, hold_ns=0),),
        accept_m=np.inf,
        position_index=position_index,
        limits=limits,
        horizon=horizon,
        dt_ns=dt_ns,
        room=room,
    )


# A motion that the plant can make, nearest to positions over time, and plans along it that end at rest.


# Cost of a change of input beside a miss of the position that it makes within a step. Without it the inputs
# would ring: a sampled plant with more than two integrations cannot follow every sample with a steady hand.
_CALM = 1e-2
# Keeps the system regular where nothing shows a state; moves nothing that is shown.
_REGULAR = 1e-12
_FIRM = 1e3  # metres of a missed position that a unit of a state is worth that a motion begins without
# A plan along a motion has to end at rest, and is to leave the motion late: what it does in a stage costs this many
# times what the same does in the next. More would brake harder than a vehicle can, less would slow it down at once.
_LATER = 2.0
# Both are of steps of this length, or longer: of shorter ones an input does less and changes less, and braking takes
# more of them.
_STEP_S = 0.2


@dataclass(frozen=True, eq=False)
class PlantMotion:
    """A motion of the plant, one row a Δt."""

    states: Array  # (n, n_x), with x(k+1) = A x(k) + B u(k)
    inputs: Array  # (n, n_u)


def follow(plant: Plant, positions_m: Array, velocities_mps: Array | None) -> PlantMotion:
    """Motion of the plant nearest to positions (and velocities) given at each Δt, by least squares over all of it.

    Args:
        plant: The plant; its model without disturbances is kept exactly.
        positions_m: (n, 3), local NED [m]; axes that the plant lacks are ignored.
        velocities_mps: (n, 3) [m/s], or None.

    """
    n, n_x, n_u, dt_s = len(positions_m), plant.n_x, plant.n_u, plant.dt_s
    columns = [AXES.index(axis) for axis in plant.axes]
    position = np.eye(n_x)[list(plant.position_index)]
    velocity = np.eye(n_x)[list(plant.velocity_index)]
    rows = [sparse.kron(sparse.eye_array(n), position)]
    right = [positions_m[:, columns].ravel()]
    if velocities_mps is not None:
        rows.append(sparse.kron(sparse.eye_array(n), dt_s * velocity))
        right.append(dt_s * velocities_mps[:, columns].ravel())
    loops = np.flatnonzero(_of_loops(plant))
    if loops.size:
        rows.append(sparse.kron(sparse.eye_array(1, n), _FIRM * np.eye(n_x)[loops]))
        right.append(np.zeros(loops.size))
    seen = sparse.vstack(rows)
    now, then = sparse.eye_array(n - 1, n), sparse.eye_array(n - 1, n, k=1)
    steps = max(2, round(2.0 * _STEP_S / plant.dt_s))
    held = sum(np.linalg.matrix_power(plant.a, step) for step in range(steps)) @ plant.b
    effect = np.linalg.norm(position @ held, axis=0) * max(_STEP_S / plant.dt_s, 1.0)
    calm = sparse.kron(then - now, np.sqrt(_CALM) * np.diag(effect))
    cost = sparse.block_diag([seen.T @ seen, calm.T @ calm])
    model = sparse.hstack([sparse.kron(now, plant.a) - sparse.kron(then, np.eye(n_x)), sparse.kron(now, plant.b)])
    regular = _REGULAR * sparse.eye_array(n * (n_x + n_u))
    system = sparse.block_array([[cost + regular, model.T], [model, None]], format="csc")
    given = np.concatenate([seen.T @ np.concatenate(right), np.zeros(n * n_u + (n - 1) * n_x)])
    from scipy.sparse.linalg import spsolve  # loaded where a trajectory is flown, for it takes long

    found = spsolve(system, given)
    return PlantMotion(states=found[: n * n_x].reshape(n, n_x), inputs=found[n * n_x : n * (n_x + n_u)].reshape(n, n_u))


def _of_loops(plant: Plant) -> NDArray[np.bool_]:
    """Return which states (n_x,) belong to the vehicle's own loops.

    They end by themselves: a motion cannot choose to begin with them, and inputs that made them zero at a given stage
    would be large.
    """
    loops = np.zeros(plant.n_x, dtype=np.bool_)
    for place in plant.velocity_index:
        loops[place + 2 : place + 1 + len(plant.further)] = True  # behind position, velocity and acceleration
    return loops


def along(plant: Plant, motion: PlantMotion, horizon: int, rest: int, lower: Array, upper: Array) -> Trajectory:
    """For each row of a motion the plan that follows it from there as long as it can and rests from stage `rest` on.

    The plan leaves the motion where inputs that grow from stage to stage bring it to rest; the place to rest at is
    what comes of that, moved inside the limits.

    Args:
        motion: The motion; it ends with at least `rest` rows of rest.
        horizon: H, stages of a plan [steps].
        lower: Least place to rest at of each axis (n_axes,) [m].

    Raises:
        DesignError: The plant cannot rest everywhere.
    """
    n, n_x, n_u = len(motion.states), plant.n_x, plant.n_u
    rows = np.minimum(np.arange(n)[:, None] + np.arange(rest + 1), n - 1)
    states, inputs = motion.states[rows], motion.inputs[rows[:, :rest]]
    reach = _reach(plant, rest)
    later = _LATER ** min(plant.dt_s / _STEP_S, 1.0)
    cost = np.asarray(np.kron(np.diag(later ** -np.arange(rest, dtype=np.float64)), np.eye(n_u)))
    rest_x, rest_u = _equilibria(plant)
    # At rest, wherever that is: the part of x_N that is no equilibrium has to vanish.
    moving, seen = _moving(plant, rest_x), ~_of_loops(plant)
    braked = states[:, rest] - states[:, rest] @ (reach[rest] @ _least(cost, moving @ reach[rest]) @ moving).T
    places = np.clip(braked[:, list(plant.position_index)], lower, upper)
    anchors, anchor_inputs = places @ rest_x, places @ rest_u
    change = (anchors - states[:, rest])[:, seen] @ _least(cost, reach[rest][seen]).T
    path_states, path_inputs = np.zeros((n, horizon, n_x)), np.zeros((n, horizon, n_u))
    for t in range(rest):
        path_states[:, t] = states[:, t] + change @ reach[t].T - anchors
        path_inputs[:, t] = inputs[:, t] + change[:, t * n_u : (t + 1) * n_u] - anchor_inputs
    return Trajectory(states=motion.states, anchors=anchors, path_states=path_states, path_inputs=path_inputs)


def room(plant: Plant, rest: int, lower: Array, upper: Array) -> Room:
    """Return where the plant may rest, and where it comes to rest by the least inputs of `rest` steps.

    Args:
        lower: Least place to rest at of each axis (n_axes,) [m].

    Raises:
        DesignError: The plant cannot rest everywhere.
    """
    rest_x, _ = _equilibria(plant)
    moving, effect = _moving(plant, rest_x), _reach(plant, rest)[rest]
    brakes = effect @ _least(np.eye(rest * plant.n_u), moving @ effect) @ moving
    stopped = (np.eye(plant.n_x) - brakes) @ np.linalg.matrix_power(plant.a, rest)
    return Room(
        axes=tuple(AXES.index(axis) for axis in plant.axes),
        lower=lower,
        upper=upper,
        rest=rest_x,
        stop=stopped[list(plant.position_index)],
    )


def _reach(plant: Plant, steps: int) -> Array:
    """Return how inputs u_0 … u_{steps-1} act on the states of stages 0 … steps (steps+1, n_x, steps n_u)."""
    reach = np.zeros((steps + 1, plant.n_x, steps * plant.n_u))
    for t in range(steps):
        reach[t + 1] = plant.a @ reach[t]
        reach[t + 1, :, t * plant.n_u : (t + 1) * plant.n_u] += plant.b
    return reach


def _least(cost: Array, effect: Array) -> Array:
    """Matrix that gives the cheapest inputs with a wanted effect (in the span of `effect`)."""
    cheap = np.linalg.solve(cost, effect.T)
    least: Array = cheap @ np.linalg.pinv(effect @ cheap, rcond=1e-10)
    return least


def _moving(plant: Plant, rest_x: Array) -> Array:
    """Rows (…, n_x) that vanish on equilibria, and elsewhere only by what ends by itself."""
    loops = _of_loops(plant)
    if not loops.any():
        return np.asarray(np.linalg.svd(rest_x)[2][len(rest_x) :])
    loops[list(plant.position_index)] = True
    return np.asarray(np.eye(plant.n_x)[~loops])


def _equilibria(plant: Plant) -> tuple[Array, Array]:
    """State (n_axes, n_x) and input (n_axes, n_u) at rest, for each metre of each axis."""
    units = [AXES.index(axis) for axis in plant.axes]
    states = np.array([plant.equilibrium((float(i == 0), float(i == 1), float(i == 2))) for i in units])
    drift = states @ (np.eye(plant.n_x) - plant.a).T
    return states, np.asarray(np.linalg.lstsq(plant.b, drift.T, rcond=None)[0].T)
