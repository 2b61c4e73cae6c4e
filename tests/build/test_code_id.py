"""Hashes of the code: they follow its sources, and nothing else."""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from uavctl.build.outside import decider_id, maker_id


@pytest.mark.parametrize("hash_of", [maker_id, decider_id], ids=["maker", "decider"])
def test_a_hash_follows_the_sources(hash_of: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def hashed() -> str:
        hash_of.cache_clear()
        found: str = hash_of()
        return found

    (tmp_path / "a.py").write_text("one", encoding="utf-8")
    own = hashed()
    with monkeypatch.context() as patch:
        patch.setattr("importlib.resources.files", lambda package: tmp_path)
        first = hashed()
        (tmp_path / "a.pyc").write_text("no source", encoding="utf-8")
        assert hashed() == first != own
        (tmp_path / "a.py").write_text("two", encoding="utf-8")
        assert hashed() != first
    assert hashed() == own


@pytest.mark.parametrize(
    ("changed", "maker", "decider"),
    [
        ("smpc/conic.py", True, True),
        ("flight/tick.py", False, True),
        ("mavlink/codec.py", False, True),
        ("config/types.py", False, True),
        ("loop.py", False, True),
        ("cli/log_cmd.py", False, False),
    ],
)
def test_each_hash_has_the_code_that_it_stands_for(
    changed: str, maker: bool, decider: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own = str(resources.files("uavctl"))
    shutil.copytree(own, tmp_path / "uavctl", ignore=shutil.ignore_patterns("__pycache__"))
    before = maker_id.__wrapped__(), decider_id.__wrapped__()
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path.joinpath(*package.split(".")))
    assert (maker_id.__wrapped__(), decider_id.__wrapped__()) == before
    with (tmp_path / "uavctl" / changed).open("a", encoding="utf-8") as file:
        file.write("# more\n")
    assert (maker_id.__wrapped__() != before[0], decider_id.__wrapped__() != before[1]) == (maker, decider)
