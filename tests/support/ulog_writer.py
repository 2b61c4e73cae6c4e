"""A writer of ULog files for tests, from the published definition of the format; it shares nothing with pyulog."""

from __future__ import annotations

import struct
from collections.abc import Sequence

MAGIC = bytes([0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35])
CODES = {"uint8_t": "B", "bool": "?", "uint64_t": "Q", "float": "f", "int32_t": "i"}


def message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<Hc", len(payload), kind.encode()) + payload


class UlogWriter:
    """Writes a header with flag bits, definitions, then data in the order of the calls."""

    def __init__(self, start_us: int) -> None:
        self._definitions = MAGIC + struct.pack("<BQ", 1, start_us) + message("B", bytes(40))
        self._data = b""
        self._layouts: dict[int, str] = {}

    def topic(self, name: str, fields: Sequence[str], instance: int = 0) -> int:
        """Define and subscribe a topic; `fields` are like `float[3] position`, the time stamp comes by itself."""
        number, layout = len(self._layouts), "<Q"
        for field in fields:
            kind, _, size = field.split()[0].rstrip("]").partition("[")
            layout += f"{size}{CODES[kind]}"
        self._layouts[number] = layout
        text = f"{name}:uint64_t timestamp;{''.join(f'{field};' for field in fields)}"
        self._definitions += message("F", text.encode())
        self._data += message("A", struct.pack("<BH", instance, number) + name.encode())
        return number

    def data(self, topic: int, at_us: int, *numbers: float) -> None:
        self._data += message("D", struct.pack("<H", topic) + struct.pack(self._layouts[topic], at_us, *numbers))

    def info(self, name: str, text: str) -> None:
        self._definitions += message("I", self._keyed(f"char[{len(text)}]", name) + text.encode())

    def parameter(self, kind: str, name: str, value: float, *, later: bool = False) -> None:
        data = message("P", self._keyed(kind, name) + struct.pack(f"<{CODES[kind]}", value))
        if later:
            self._data += data
        else:
            self._definitions += data

    def text(self, severity: int, at_us: int, text: str) -> None:
        self._data += message("L", struct.pack("<cQ", str(severity).encode(), at_us) + text.encode())

    def dropout(self, duration_ms: int) -> None:
        self._data += message("O", struct.pack("<H", duration_ms))

    @property
    def file(self) -> bytes:
        return self._definitions + self._data

    @property
    def definitions_bytes(self) -> int:
        return len(self._definitions)

    @staticmethod
    def _keyed(kind: str, name: str) -> bytes:
        key = f"{kind} {name}".encode()
        return bytes([len(key)]) + key
