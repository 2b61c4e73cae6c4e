"""The hash of the code that decides: it follows its sources, and nothing else."""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path

import pytest

from uavctl.wiring.outside import compute_code_id


def test_the_hash_follows_the_sources(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def hashed() -> str:
        compute_code_id.cache_clear()
        return compute_code_id()

    (tmp_path / "a.py").write_text("one", encoding="utf-8")
    code_id = hashed()
    with monkeypatch.context() as patch:
        patch.setattr("importlib.resources.files", lambda package: tmp_path)
        first = hashed()
        (tmp_path / "a.pyc").write_text("no source", encoding="utf-8")
        assert hashed() == first != code_id
        (tmp_path / "a.py").write_text("two", encoding="utf-8")
        assert hashed() != first
    assert hashed() == code_id


@pytest.mark.parametrize(
    ("changed", "decides"),
    [
        ("smpc/conic.py", True),
        ("flight/tick.py", True),
        ("mavlink/codec.py", True),
        ("config/types.py", True),
        ("loop.py", True),
        ("cli/log_cmd.py", False),
    ],
)
def test_it_has_the_code_that_decides_and_no_other(
    changed: str, decides: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    package_folder = str(resources.files("uavctl"))
    shutil.copytree(package_folder, tmp_path / "uavctl", ignore=shutil.ignore_patterns("__pycache__"))
    before = compute_code_id.__wrapped__()
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path.joinpath(*package.split(".")))
    assert compute_code_id.__wrapped__() == before
    with (tmp_path / "uavctl" / changed).open("a", encoding="utf-8") as file:
        file.write("# more\n")
    assert (compute_code_id.__wrapped__() != before) == decides
