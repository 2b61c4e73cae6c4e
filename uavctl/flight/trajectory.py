"""A motion that the plant can make, nearest to positions over time, and plans along it that end at rest.

1. `follow_positions` finds the motion by least squares over all of it; the model is kept exactly.
2. `plan_along` makes a plan from each row: it follows the motion as long as it can, and then rests.
3. `make_rest_region` finds where the plant may rest, and where it comes to rest by the least inputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from uavctl.arrays import Array
from uavctl.flight.mission import RestRegion, Trajectory
from uavctl.smpc.plant import AXES, Plant

# Cost of a change of input beside a miss of the position that it makes within a step. Without it the inputs
# would ring: a sampled plant with more than two integrations cannot follow every sample with a steady hand.
_INPUT_CHANGE_COST = 1e-2
# Keeps the system regular where nothing shows a state; moves nothing that is shown.
_REGULARIZATION = 1e-12
_LOOP_STATE_COST = 1e3  # metres of a missed position that cost as much as a unit of a loop state at the begin
# A plan along a motion has to end at rest, and is to leave the motion late. A change of input costs this many times as
# much as a stage later. More would brake harder than a vehicle can, less would slow it down at once.
_STAGE_COST_RATIO = 2.0
# `_INPUT_CHANGE_COST` and `_STAGE_COST_RATIO` hold for steps of this length, or longer: in a shorter one an input does
# less and changes less, and braking takes more of them.
_STEP_S = 0.2


@dataclass(frozen=True, eq=False)
class PlantMotion:
    """A motion of the plant, one row a Δt."""

    states: Array  # (n, n_x), with x(k+1) = A x(k) + B u(k)
    inputs: Array  # (n, n_u)


def follow_positions(plant: Plant, positions_m: Array, velocities_mps: Array | None) -> PlantMotion:
    """Find the plant's motion nearest to positions (and velocities) given at each Δt, by least squares over all of it.

    Args:
        plant: The plant; its model without disturbances is kept exactly.
        positions_m: (n, 3), local NED [m]; axes that the plant lacks are ignored.
        velocities_mps: (n, 3) [m/s], or None.

    """
    if plant.gust_mps2:  # a motion has none
        calm = follow_positions(plant.without_gusts(), positions_m, velocities_mps)
        return PlantMotion(np.pad(calm.states, ((0, 0), (0, len(plant.gust_mps2)))), calm.inputs)
    n, n_x, n_u, dt_s = len(positions_m), plant.n_x, plant.n_u, plant.dt_s
    columns = [AXES.index(axis) for axis in plant.axes]
    position = np.eye(n_x)[list(plant.position_index)]
    velocity = np.eye(n_x)[list(plant.velocity_index)]
    rows = [sparse.kron(sparse.eye_array(n), position)]
    right = [positions_m[:, columns].ravel()]
    if velocities_mps is not None:
        rows.append(sparse.kron(sparse.eye_array(n), dt_s * velocity))
        right.append(dt_s * velocities_mps[:, columns].ravel())
    loops = np.flatnonzero(_find_loop_states(plant))
    if loops.size:
        rows.append(sparse.kron(sparse.eye_array(1, n), _LOOP_STATE_COST * np.eye(n_x)[loops]))
        right.append(np.zeros(loops.size))
    shown = sparse.vstack(rows)
    now, then = sparse.eye_array(n - 1, n), sparse.eye_array(n - 1, n, k=1)
    steps = max(2, round(2.0 * _STEP_S / plant.dt_s))
    held = sum(np.linalg.matrix_power(plant.a, step) for step in range(steps)) @ plant.b
    effect = np.linalg.norm(position @ held, axis=0) * max(_STEP_S / plant.dt_s, 1.0)
    input_change = sparse.kron(then - now, np.sqrt(_INPUT_CHANGE_COST) * np.diag(effect))
    cost = sparse.block_diag([shown.T @ shown, input_change.T @ input_change])
    model = sparse.hstack([sparse.kron(now, plant.a) - sparse.kron(then, np.eye(n_x)), sparse.kron(now, plant.b)])
    regularization = _REGULARIZATION * sparse.eye_array(n * (n_x + n_u))
    system = sparse.block_array([[cost + regularization, model.T], [model, None]], format="csc")
    given = np.concatenate([shown.T @ np.concatenate(right), np.zeros(n * n_u + (n - 1) * n_x)])
    from scipy.sparse.linalg import spsolve  # loaded where a trajectory is flown, for it takes long

    found = spsolve(system, given)
    return PlantMotion(states=found[: n * n_x].reshape(n, n_x), inputs=found[n * n_x : n * (n_x + n_u)].reshape(n, n_u))


def _find_loop_states(plant: Plant) -> NDArray[np.bool_]:
    """Return which states (n_x,) belong to the vehicle's own loops.

    They decay by themselves: a motion cannot choose to begin with them, and inputs that made them zero at a given
    stage would be large.
    """
    loops = np.zeros(plant.n_x, dtype=np.bool_)
    for place in plant.velocity_index:
        loops[place + 2 : place + 1 + len(plant.extra_states)] = True  # behind position, velocity and acceleration
    return loops


def plan_along(
    plant: Plant, motion: PlantMotion, horizon: int, arrival_stage: int, lower: Array, upper: Array
) -> Trajectory:
    """Make for each row of a motion the plan that follows it as long as it can and rests from `arrival_stage` on.

    The plan leaves the motion where inputs that grow from stage to stage bring it to rest. The place to rest at is
    where they end, moved inside the limits.

    Args:
        motion: The motion; it ends with at least `arrival_stage` rows of rest.
        horizon: H, stages of a plan [steps].
        lower: Least place to rest at of each axis (n_axes,) [m].

    Raises:
        DesignError: The plant cannot rest everywhere.
    """
    n, n_x, n_u = len(motion.states), plant.n_x, plant.n_u
    rows = np.minimum(np.arange(n)[:, None] + np.arange(arrival_stage + 1), n - 1)
    states, inputs = motion.states[rows], motion.inputs[rows[:, :arrival_stage]]
    effects = _compute_input_effects(plant, arrival_stage)
    stage_ratio = _STAGE_COST_RATIO ** min(plant.dt_s / _STEP_S, 1.0)
    cost = np.asarray(np.kron(np.diag(stage_ratio ** -np.arange(arrival_stage, dtype=np.float64)), np.eye(n_u)))
    rest_x, rest_u = _compute_equilibria(plant)
    # At rest, wherever that is: the part of x_N that is no equilibrium has to vanish.
    motion_rows, shown = _make_motion_rows(plant, rest_x), ~_find_loop_states(plant)
    # x_brake = x_N - R L(M R) M x_N, with R the effects of N steps and L the map to the least inputs
    last, last_effects = states[:, arrival_stage], effects[arrival_stage]
    brakes = last_effects @ _make_least_input_map(cost, motion_rows @ last_effects) @ motion_rows
    braked = last - last @ brakes.T
    places = np.clip(braked[:, list(plant.position_index)], lower, upper)
    anchors, anchor_inputs = places @ rest_x, places @ rest_u
    # Δu = L(R) (x_anchor - x_N)
    change = (anchors - last)[:, shown] @ _make_least_input_map(cost, last_effects[shown]).T
    path_states, path_inputs = np.zeros((n, horizon, n_x)), np.zeros((n, horizon, n_u))
    for t in range(arrival_stage):
        # x_t = x_t + R_t Δu - x_anchor; u_t = u_t + Δu_t - u_anchor
        path_states[:, t] = states[:, t] + change @ effects[t].T - anchors
        path_inputs[:, t] = inputs[:, t] + change[:, t * n_u : (t + 1) * n_u] - anchor_inputs
    return Trajectory(states=motion.states, anchors=anchors, path_states=path_states, path_inputs=path_inputs)


def make_rest_region(plant: Plant, arrival_stage: int, lower: Array, upper: Array) -> RestRegion:
    """Return where the plant may rest, and where it comes to rest by the least inputs of `arrival_stage` steps.

    Args:
        lower: Least place to rest at of each axis (n_axes,) [m].

    Raises:
        DesignError: The plant cannot rest everywhere.
    """
    rest_x, _ = _compute_equilibria(plant)
    motion_rows, effect = _make_motion_rows(plant, rest_x), _compute_input_effects(plant, arrival_stage)[arrival_stage]
    # B = R L(M R) M; x_stop = (I - B) A^N x
    brakes = effect @ _make_least_input_map(np.eye(arrival_stage * plant.n_u), motion_rows @ effect) @ motion_rows
    stopped = (np.eye(plant.n_x) - brakes) @ np.linalg.matrix_power(plant.a, arrival_stage)
    return RestRegion(
        axes=tuple(AXES.index(axis) for axis in plant.axes),
        lower=lower,
        upper=upper,
        equilibrium_map=rest_x,
        stop_map=stopped[list(plant.position_index)],
    )


def _compute_input_effects(plant: Plant, steps: int) -> Array:
    """Return how inputs u_0 … u_{steps-1} act on the states of stages 0 … steps (steps+1, n_x, steps n_u)."""
    effects = np.zeros((steps + 1, plant.n_x, steps * plant.n_u))
    for t in range(steps):
        # R_t+1 = A R_t + (0 … B … 0), B in the columns of u_t
        effects[t + 1] = plant.a @ effects[t]
        effects[t + 1, :, t * plant.n_u : (t + 1) * plant.n_u] += plant.b
    return effects


def _make_least_input_map(cost: Array, effect: Array) -> Array:
    """Make the matrix that gives the cheapest inputs with a wanted effect (in the span of `effect`)."""
    # L = Q⁻¹ R' (R Q⁻¹ R')⁺
    cheap = np.linalg.solve(cost, effect.T)
    least: Array = cheap @ np.linalg.pinv(effect @ cheap, rcond=1e-10)
    return least


def _make_motion_rows(plant: Plant, rest_x: Array) -> Array:
    """Make rows (…, n_x) that are zero at equilibria, and elsewhere only by states that decay by themselves."""
    loops = _find_loop_states(plant)
    if not loops.any():
        return np.asarray(np.linalg.svd(rest_x)[2][len(rest_x) :])
    loops[list(plant.position_index)] = True
    return np.asarray(np.eye(plant.n_x)[~loops])


def _compute_equilibria(plant: Plant) -> tuple[Array, Array]:
    """Compute the state (n_axes, n_x) and input (n_axes, n_u) at rest, for each metre of each axis."""
    units = [AXES.index(axis) for axis in plant.axes]
    states = np.array([plant.equilibrium((float(i == 0), float(i == 1), float(i == 2))) for i in units])
    # x = A x + B u: B u = (I - A) x
    drift = states @ (np.eye(plant.n_x) - plant.a).T
    return states, np.asarray(np.linalg.lstsq(plant.b, drift.T, rcond=None)[0].T)
