# natnet 0.3.0: the part that is used here.

class NatNetError(Exception): ...

class Version:
    def __init__(self, *components: int) -> None: ...

class PacketBuffer:
    pointer: int
    def __init__(self, data: bytes) -> None: ...
    @property
    def data(self) -> memoryview: ...
    def read_string(self, max_length: int | None = None, static_length: bool = False) -> str: ...
    def read_float32_array(self, count: int) -> tuple[float, ...]: ...

class RigidBodyDescription:
    name: str | None
    id_num: int

class DataDescriptions:
    rigid_bodies: tuple[RigidBodyDescription, ...]
    @classmethod
    def read_from_buffer(cls, buffer: PacketBuffer, protocol_version: Version) -> DataDescriptions: ...

class RigidBody:
    id_num: int
    pos: tuple[float, float, float]
    rot: tuple[float, float, float, float]
    tracking_valid: bool | None

class FrameSuffix:
    stamp_camera_mid_exposure: int | None
    stamp_transmit: int | None

class DataFrame:
    rigid_bodies: tuple[RigidBody, ...]
    suffix: FrameSuffix
    @classmethod
    def read_from_buffer(cls, buffer: PacketBuffer, protocol_version: Version) -> DataFrame: ...
