"""Parts of messages that are filled in, against those made one by one."""

from __future__ import annotations

import numpy as np
import pytest
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

from logs.recording.views import RepeatedField


def poses(places: list[list[float]]) -> PosesInFrame:
    message = PosesInFrame()
    for x, y, z in places:
        one = message.poses.add()
        one.position.x, one.position.y, one.position.z = x, y, z
        one.orientation.w = 1.0
    return message


@pytest.mark.parametrize("count", [0, 1, 49])
def test_they_are_those_made_one_by_one(count: int) -> None:
    places = np.random.default_rng(1).normal(size=(count, 3))
    places[::3, 1] = 0.0
    places[1::7, 2] = [np.inf] * len(places[1::7])
    filled = PosesInFrame(frame_id="ned")
    filled.MergeFromString(RepeatedField(lambda at_m: poses([[*at_m]]), 3).encode(places))
    made = poses(places.tolist())
    made.frame_id = "ned"
    assert filled.SerializeToString() == made.SerializeToString()


def test_a_number_that_the_part_has_not_is_an_error() -> None:
    with pytest.raises(ValueError, match="not found"):
        RepeatedField(lambda at_m: poses([[*at_m][:3]]), 4)
