"""The common dialect, with the types of the larger one."""

from typing import Any

from pymavlink.dialects.v20.ardupilotmega import MAVError as MAVError
from pymavlink.dialects.v20.ardupilotmega import MAVLink as MAVLink
from pymavlink.dialects.v20.ardupilotmega import MAVLink_message as MAVLink_message
from pymavlink.dialects.v20.ardupilotmega import mavlink_map as mavlink_map
from pymavlink.dialects.v20.ardupilotmega import x25crc as x25crc

def __getattr__(name: str) -> Any: ...
