"""Key files: forms, permissions, and what is told of them."""

from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path

import pytest
from signing_rig import KEY

from uavctl.cli.app import run
from uavctl.errors import KeyFileError
from uavctl.io.key_file import new_key, read_key
from uavctl.mavlink.signing import SigningKey

WORDS = "correct horse battery staple"
RAW = bytes(range(200, 232))


def written(folder: Path, data: bytes, mode: int = 0o600) -> Path:
    path = folder / "vehicle.key"
    path.write_bytes(data)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("data", "secret"),
    [
        (RAW, RAW),
        (KEY.hex().encode(), KEY),
        (KEY.hex().upper().encode() + b"\n", KEY),
        (f"passphrase: {WORDS}\n".encode(), hashlib.sha256(WORDS.encode()).digest()),
        (f"  passphrase:{WORDS}  ".encode(), hashlib.sha256(WORDS.encode()).digest()),
    ],
)
def test_a_key_is_bytes_digits_or_words(tmp_path: Path, data: bytes, secret: bytes) -> None:
    assert read_key(written(tmp_path, data)).name == SigningKey(secret).name


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\n",
        RAW[:-1],
        b"thirty-two letters are no bytes!",
        KEY.hex().encode()[:-1],
        KEY.hex().encode()[:-1] + b"x",
        b"0" * 64,
        b"passwort: correct horse battery staple",
        b"x" * 5000,
    ],
)
def test_what_is_no_key_is_refused_without_a_word_of_it(tmp_path: Path, data: bytes) -> None:
    path = written(tmp_path, data)
    with pytest.raises(KeyFileError, match="holds no key; give 32 random bytes") as refused:
        read_key(path)
    text = str(refused.value)
    assert not data.strip() or data.decode("latin1").strip() not in text


def test_a_short_passphrase_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match="guessed") as refused:
        read_key(written(tmp_path, b"passphrase: drone"))
    assert "drone" not in str(refused.value).replace(str(tmp_path), "")


@pytest.mark.fault(40)
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o644, 0o666, 0o601, 0o610])
def test_a_key_that_others_can_use_is_refused_with_the_chmod_to_run(tmp_path: Path, mode: int) -> None:
    path = written(tmp_path, KEY.hex().encode(), mode)
    with pytest.raises(KeyFileError, match=f"run `chmod 600 {path}`"):
        read_key(path)
    path.chmod(0o600)
    assert read_key(path).name == SigningKey(KEY).name
    path.chmod(0o400)
    assert read_key(path)


def test_a_missing_file_and_a_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match="uavctl key new"):
        read_key(tmp_path / "none.key")
    with pytest.raises(KeyFileError, match="directory"):
        read_key(tmp_path)


@pytest.mark.fault(40)
def test_a_new_key_is_its_owner_s_alone_and_never_written_over(tmp_path: Path) -> None:
    path = tmp_path / "new.key"
    name = new_key(path).name
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_key(path).name == name
    text = path.read_bytes()
    words = text.removeprefix(b"passphrase: ").strip()
    assert SigningKey(hashlib.sha256(words).digest()).name == name  # what a ground station makes of the words
    assert words.isascii() and len(words) == 39
    with pytest.raises(KeyFileError, match="is there already"):
        new_key(path)
    assert path.read_bytes() == text
    assert new_key(tmp_path / "other.key").name != name
    with pytest.raises(KeyFileError, match="place that can be written"):
        new_key(tmp_path / "nowhere" / "new.key")


@pytest.mark.fault(40)
def test_the_command_makes_one_and_shows_nothing_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new.key"
    assert run(["key", "new", str(path)]) == 0
    output = capsys.readouterr()
    words = path.read_text().removeprefix("passphrase: ").strip()
    assert read_key(path).name in output.out
    assert words not in output.out + output.err
    assert run(["key", "show", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"schema": "uavctl/key/1", "file": str(path), "name": read_key(path).name}
    assert run(["key", "new", str(path)]) == 2
    assert "is there already" in capsys.readouterr().err
    path.chmod(0o644)
    assert run(["key", "show", str(path)]) == 2
    assert "chmod 600" in capsys.readouterr().err.replace("\n", " ")
