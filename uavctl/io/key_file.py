"""Files of signing keys. Reading checks that no other user can read the file.

A file holds 32 bytes, or 64 hexadecimal digits, or a line `passphrase: …`. The key of a passphrase is its SHA-256, as
in MAVProxy, Mission Planner and pymavlink's tools.
"""

from __future__ import annotations

import base64
import hashlib
import os
import stat
from pathlib import Path

from uavctl.errors import KeyFileError
from uavctl.mavlink.signing import KEY_BYTES, SigningKey

PASSPHRASE = b"passphrase:"
MIN_PASSPHRASE = 16  # characters; shorter ones are guessed from one signed frame
_LARGEST = 4096
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_RANDOM_BYTES = 20
_GROUP = 4


def read_key(path: Path) -> SigningKey:
    """The key in a file.

    Raises:
        KeyFileError: it cannot be read, others can read it, or it holds no key; names the remedy.
    """
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(_LARGEST)
    except OSError as error:
        raise KeyFileError(f"key file {path}: {error.strerror}; `uavctl key new {path}` makes one") from error
    if status.st_mode & _OTHERS:
        mode = stat.S_IMODE(status.st_mode)
        raise KeyFileError(
            f"key file {path}: others than its owner may use it (mode {mode:04o}); run `chmod 600 {path}`, and make a "
            "new key if others may have read it"
        )
    return _parse_key(path, data)


def _parse_key(path: Path, data: bytes) -> SigningKey:
    text = data.strip()
    try:
        if text.startswith(PASSPHRASE):
            passphrase = text.removeprefix(PASSPHRASE).strip()
            if len(passphrase) < MIN_PASSPHRASE:
                raise KeyFileError(
                    f"key file {path}: a passphrase of fewer than {MIN_PASSPHRASE} characters is guessed from one "
                    "signed frame; `uavctl key new FILE` makes a good one"
                )
            return SigningKey(hashlib.sha256(passphrase).digest())
        if len(text) == 2 * KEY_BYTES:
            return SigningKey(bytes.fromhex(text.decode("ascii")))
        # 32 letters are probably a passphrase without its mark; random bytes contain others.
        if len(data) == KEY_BYTES and not data.isascii():
            return SigningKey(data)
    except ValueError:
        pass  # reported below, without the content of the file
    raise KeyFileError(
        f"key file {path}: holds no key; give {KEY_BYTES} random bytes, {2 * KEY_BYTES} hexadecimal digits, or a line "
        "`passphrase: …`"
    )


def new_key(path: Path) -> SigningKey:
    """Write a new random passphrase, which other tools take too, to a file that only its owner can read.

    Raises:
        KeyFileError: the file is there already, or cannot be written.
    """
    letters = base64.b32encode(os.urandom(_RANDOM_BYTES)).decode("ascii").lower()
    passphrase = "-".join(letters[i : i + _GROUP] for i in range(0, len(letters), _GROUP))
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(f"{PASSPHRASE.decode('ascii')} {passphrase}\n")
            file.flush()
            os.fsync(file.fileno())
    except FileExistsError as error:
        raise KeyFileError(f"key file {path}: is there already, and is not written over; give another name") from error
    except OSError as error:
        raise KeyFileError(f"key file {path}: {error.strerror}; give a place that can be written") from error
    return read_key(path)
