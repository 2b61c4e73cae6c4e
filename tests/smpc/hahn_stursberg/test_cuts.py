"""A recording that is cut at any byte is recovered and replays identically up to there."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest
from cut_rig import NAME, Cuts
from report_rig import omit_pages

from uavctl.cli.app import run
from uavctl.cli.replays import make_recorded_controller
from uavctl.config import Config
from uavctl.wiring.controller import Prepared

SMALL = ("--config", "paper", "--set", "solver.method=exact", "--set", "log={segment_bytes=100000, chunk_bytes=4096}")


@pytest.fixture(scope="module")
def cuts(tmp_path_factory: pytest.TempPathFactory) -> Cuts:
    folder = tmp_path_factory.mktemp("flown")
    with omit_pages():
        assert run(["loopback", *SMALL, "--duration", "4", "--out", str(folder), "--json"]) == 0
    return Cuts(folder / NAME)


@pytest.fixture(autouse=True, scope="module")
def _designed_once(cuts: Cuts) -> Iterator[None]:
    """All cuts are of one flight. A flight leaves no state in its controller; a replay would show it."""

    @lru_cache
    def flyer(config: Config) -> Prepared:
        return make_recorded_controller(cuts.files[0], config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavctl.cli.replays.make_recorded_controller", lambda _, config: flyer(config))
        yield


def all_wrong(cuts: Cuts, places: list[tuple[int, int]]) -> dict[tuple[int, int], str]:
    result = {}
    for place in places:
        with tempfile.TemporaryDirectory() as folder:
            result[place] = cuts.find_problem(Path(folder), *place)
    return {place: text for place, text in result.items() if text}


def thinned(cuts: Cuts) -> list[tuple[int, int]]:
    """All places around a file's first and last chunk; of the six beside each other chunk, each kind in turn."""
    within = []
    for file in range(len(cuts.files)):
        chunks = [item for item in cuts.chunks if item.file == file]
        within.append(range(chunks[0].indexed + 2, chunks[-1].end - 1))
    # 5 has no factor in common with 6, and is less: no chunk is left out.
    return [(file, size) for i, (file, size) in enumerate(cuts.cut_points()) if i % 5 == 0 or size not in within[file]]


@pytest.mark.long
@pytest.mark.fault(52)
def test_cut_near_the_end_of_every_chunk(cuts: Cuts) -> None:
    assert len(cuts.files) > 1 and len(cuts.chunks) > 8
    assert all_wrong(cuts, thinned(cuts)) == {}
    assert cuts.straddled >= 10  # ticks of which the decision is beyond the cut


@pytest.mark.fault(52)
@pytest.mark.parametrize("number", [6, pytest.param(20, marks=pytest.mark.slow)])
def test_cut_anywhere(cuts: Cuts, number: int) -> None:
    assert all_wrong(cuts, cuts.draw_cuts(number, seed=1)) == {}
