# qtm-rt 3.1.0: the part that is used here.

from enum import Enum
from typing import NamedTuple

class QRTComponentType(Enum):
    Component6d = 5

class RT6DComponent(NamedTuple):
    body_count: int
    drop_rate: int
    out_of_sync_rate: int

class RT6DBodyPosition(NamedTuple):
    x: float
    y: float
    z: float

class RT6DBodyRotation(NamedTuple):
    matrix: tuple[float, ...]

class QRTPacket:
    timestamp: int
    framenumber: int
    components: dict[QRTComponentType, int]
    def __init__(self, data: bytes) -> None: ...
    def get_6d(self) -> tuple[RT6DComponent, list[tuple[RT6DBodyPosition, RT6DBodyRotation]]]: ...
