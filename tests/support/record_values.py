"""Any value of any record, for tests by hypothesis."""

from __future__ import annotations

import math
import types
import typing
from enum import Enum

import msgspec
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from uavctl.arrays import Array


def values(kind: object) -> st.SearchStrategy[object]:
    """Any value of a field's type; texts look like spelled floats now and then."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if kind == Array:
        # A matrix without rows has no columns in a recording either.
        shapes = st.tuples(st.integers(1, 3), st.integers(0, 3)) | st.just((0, 0))
        return shapes.flatmap(lambda shape: arrays(np.float64, shape, elements=values(float)))
    if origin is types.UnionType:
        return st.one_of(*map(values, args))
    if origin is tuple and args[-1] is Ellipsis:
        return st.lists(values(args[0]), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*map(values, args))
    if origin is dict:
        return st.dictionaries(st.text(max_size=3), values(args[1]), max_size=3)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return st.sampled_from(list(kind))
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return st.builds(kind, **{field.name: values(field.type) for field in msgspec.structs.fields(kind)})
    plain: dict[object, st.SearchStrategy[object]] = {
        float: st.floats() | st.sampled_from([math.nan, math.inf, -math.inf, -0.0, 5e-324]),
        int: st.integers(-(2**63), 2**63 - 1),
        bool: st.booleans(),
        bytes: st.binary(max_size=8),
        str: st.text(max_size=5) | st.sampled_from(["NaN", "Infinity", "-Infinity", "null", 'x"NaN"']),
        type(None): st.none(),
        object: st.recursive(
            st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=3),
            lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
            max_leaves=4,
        ),
    }
    return plain[kind]
