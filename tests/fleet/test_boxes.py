"""Separating planes of all pairs at once, against a slow version that divides one pair and stage after the other."""

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.fleet.boxes import ROUNDING_M, Boxes, divide_pairs, find_gaps

DISTANCE_M = 0.5
LEVEL = (0, 1)


def draw_boxes(rng: np.random.Generator, vehicles: int, stages: int) -> tuple[Boxes, Boxes]:
    """Draw claims, and plans inside of them."""
    middle = rng.uniform(-3.0, 3.0, (vehicles, stages, 3))
    half = rng.uniform(0.05, 0.6, (vehicles, stages, 3))
    claims = Boxes(middle - half, middle + half)
    low, high = np.sort(rng.uniform(claims.lower_m, claims.upper_m, (2, vehicles, stages, 3)), axis=0)
    return claims, Boxes(low, high)


def divide_slowly(claims: Boxes, plans: Boxes) -> tuple[Array, Array, list[bool]]:
    vehicles, stages, _ = claims.lower_m.shape
    lower, upper, divided = (
        np.full(plans.lower_m.shape, -np.inf),
        np.full(plans.lower_m.shape, np.inf),
        [True] * vehicles,
    )
    for i in range(vehicles):
        for j in range(i + 1, vehicles):
            for s in range(stages):
                best = None
                for low, high in ((i, j), (j, i)):
                    for axis in LEVEL:
                        if claims.lower_m[high, s, axis] - claims.upper_m[low, s, axis] < DISTANCE_M:
                            continue
                        width = sum((plans.upper_m[v, s, axis] - plans.lower_m[v, s, axis]) / 2 for v in (low, high))
                        means = [(plans.upper_m[v, s, axis] + plans.lower_m[v, s, axis]) / 2 for v in (low, high)]
                        ratio = (means[1] - means[0]) / (width + DISTANCE_M)
                        if best is None or ratio > best[0]:
                            best = ratio, low, high, axis
                if best is None:
                    divided[i] = divided[j] = False
                    continue
                _, low, high, axis = best
                plane = (plans.upper_m[low, s, axis] + plans.lower_m[high, s, axis]) / 2
                plane = max(plane, claims.upper_m[low, s, axis] + DISTANCE_M / 2)
                plane = min(plane, claims.lower_m[high, s, axis] - DISTANCE_M / 2)
                upper[low, s, axis] = min(upper[low, s, axis], plane - DISTANCE_M / 2)
                lower[high, s, axis] = max(lower[high, s, axis], plane + DISTANCE_M / 2)
    return lower, upper, divided


@pytest.mark.parametrize("seed", range(20))
def test_all_pairs_at_once_are_divided_like_one_after_the_other(seed: int) -> None:
    claims, plans = draw_boxes(np.random.default_rng(seed), 6, 4)
    bounds = divide_pairs(claims, plans, DISTANCE_M)
    lower, upper, divided = divide_slowly(claims, plans)
    np.testing.assert_allclose(bounds.lower_m, lower, atol=1e-12)
    np.testing.assert_allclose(bounds.upper_m, upper, atol=1e-12)
    assert bounds.is_divided.tolist() == divided


def test_planes_never_cut_a_claim_and_keep_the_distance() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        claims, plans = draw_boxes(rng, 4, 3)
        bounds = divide_pairs(claims, plans, DISTANCE_M)
        assert (bounds.lower_m <= claims.lower_m + ROUNDING_M).all()
        assert (bounds.upper_m >= claims.upper_m - ROUNDING_M).all()
        # The largest boxes that the planes leave are apart, and so are they and all claims
        largest = Boxes(np.maximum(bounds.lower_m, -10.0), np.minimum(bounds.upper_m, 10.0))
        apart = np.triu(np.outer(bounds.is_divided, bounds.is_divided), 1)
        for other in (largest, claims):
            assert find_gaps(largest, other, DISTANCE_M)[apart].min(initial=1.0) >= 1.0 - 1e-9


def test_a_vehicle_without_a_claim_is_not_divided_from_others() -> None:
    claims, plans = draw_boxes(np.random.default_rng(2), 3, 2)
    alone = Boxes.make_empty(3, 2).take(np.array([False, True, True]), claims)
    bounds = divide_pairs(alone, plans, DISTANCE_M)
    assert np.isinf(bounds.lower_m).all()
    assert np.isinf(bounds.upper_m).all()


def test_boxes_above_each_other_are_not_apart() -> None:
    """Their vehicles would meet on the floor where both land, however far apart in height they are."""
    claims = Boxes(
        np.array([[[0.0, 0.0, -9.0]], [[0.0, 0.0, -1.0]]]), np.array([[[1.0, 1.0, -8.0]], [[1.0, 1.0, 0.0]]])
    )
    assert find_gaps(claims, claims, DISTANCE_M).max() < 1.0
    assert not divide_pairs(claims, claims, DISTANCE_M).is_divided.any()


def test_two_claims_too_near_are_not_divided() -> None:
    claims = Boxes(np.zeros((2, 1, 3)), np.ones((2, 1, 3)))
    assert not divide_pairs(claims, claims, DISTANCE_M).is_divided.any()


def test_boxes_advance_to_the_last_one() -> None:
    claims, _ = draw_boxes(np.random.default_rng(3), 1, 3)
    np.testing.assert_array_equal(claims.advance(1).lower_m[0], claims.lower_m[0, [1, 2, 2]])
    np.testing.assert_array_equal(claims.advance(9).upper_m[0], claims.upper_m[0, [2, 2, 2]])
