"""Policy libraries as bytes and files: nothing wrong is ever read, and nothing is made twice."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from optimisation_cases import START, paper_spec

from uavctl.build import library as library_store
from uavctl.build.library import (
    Advance,
    LibraryCheck,
    cache_file,
    check_fits,
    check_library,
    decode,
    encode,
    library_for,
    load,
)
from uavctl.build.outside import maker_id
from uavctl.errors import DesignError, LibraryError
from uavctl.smpc.hahn_stursberg.design import Design, make_design
from uavctl.smpc.hahn_stursberg.horizon import decompose, horizon_of
from uavctl.smpc.hahn_stursberg.library import Library, LibrarySolver, PartLibrary
from uavctl.smpc.hahn_stursberg.mean import MeanProblem
from uavctl.smpc.hahn_stursberg.policies import PolicyProgram

NAMES = ("component 0", "component 1")
CHECK = LibraryCheck(states=4, methods={"frozen": 1, "mixture": 3, "exact": 0}, worst_gap=2e-5)


def cheapest(design: Design) -> Library:
    """A library of one policy a component, made at once."""
    parts = []
    for component in decompose(design):
        policy = PolicyProgram(MeanProblem(design, horizon_of(design, component)), design.max_iterations).cheapest()
        assert policy is not None
        parts.append(PartLibrary(policy.theta[None], np.array([policy.level]), policy.slope[None]))
    return Library(design.design_id, (tuple(parts),))


@pytest.fixture(scope="module")
def design() -> Design:
    return make_design(paper_spec())


@pytest.fixture(scope="module")
def library(design: Design) -> Library:
    return cheapest(design)


@pytest.fixture(scope="module")
def data(library: Library) -> bytes:
    return encode(library, NAMES, CHECK, 1.5)


class Grower:
    """Stands for the seconds of growth; counts how often it was asked."""

    def __init__(self, library: Library) -> None:
        self.library = library
        self.calls = 0
        self.begun, self.release = threading.Event(), threading.Event()
        self.release.set()
        self.fails = False

    def __call__(self, design: Design, seed: int = 0, advance: Advance | None = None) -> Library:
        self.calls += 1
        self.begun.set()
        assert self.release.wait(30.0)
        if self.fails:
            raise DesignError("smpc.k_tau", "no policy", "none")
        if advance is not None:
            for count in (1, 2):
                for name in NAMES:
                    advance(name, count, 1.0 / count)
        return self.library


@pytest.fixture
def grower(library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Grower:
    made = Grower(library)
    monkeypatch.setattr(library_store, "make_library", made)
    monkeypatch.setattr(library_store, "check_library", lambda design, library: CHECK)
    monkeypatch.setenv("UAVCTL_CACHE", str(tmp_path / "cache"))
    return made


def nudged(library: Library, factor: float = 1.0 + 2.0**-52) -> Library:
    """The same library but for one number."""
    theta = library.variants[0][0].theta.copy()
    theta[0, 0] *= factor
    return Library(library.design_id, ((replace(library.variants[0][0], theta=theta), *library.variants[0][1:]),))


def test_bytes_give_every_bit_back(library: Library, data: bytes) -> None:
    stored = decode(data)
    assert stored.library.design_id == library.design_id
    for mine, its in zip(stored.library.variants[0], library.variants[0], strict=True):
        for name in ("theta", "level", "slope"):
            one, other = getattr(mine, name), getattr(its, name)
            assert (one.dtype, one.shape) == (np.float64, other.shape)
            assert one.tobytes() == other.tobytes()
    assert (stored.names, stored.check, stored.made_s, stored.sizes) == (NAMES, CHECK, 1.5, (1, 1))
    assert encode(stored.library, stored.names, stored.check, stored.made_s) == stored.data == data


def test_late_components_keep_their_places(library: Library) -> None:
    (parts,) = library.variants
    late = Library("d", (parts, parts[::-1]))
    stored = decode(encode(late, ("a", "b", "c", "d"), CHECK, 0.0))
    found = [[part.theta.tolist() for part in variant] for variant in stored.library.variants]
    assert found == [[part.theta.tolist() for part in variant] for variant in late.variants]


def test_the_hash_is_of_the_numbers_and_the_design(library: Library) -> None:
    one = decode(encode(library, NAMES, CHECK, 1.5)).library_id
    assert decode(encode(library, NAMES, msgspec.structs.replace(CHECK, worst_gap=0.0), 9.0)).library_id == one
    assert decode(encode(nudged(library), NAMES, CHECK, 1.5)).library_id != one
    assert decode(encode(replace(library, design_id="other"), NAMES, CHECK, 1.5)).library_id != one


def test_no_flipped_bit_is_read_as_a_library(data: bytes) -> None:
    for position in random.Random(1).sample(range(len(data)), 400):
        wrong = bytearray(data)
        wrong[position] ^= 1 << position % 8
        with pytest.raises(LibraryError):
            decode(bytes(wrong))
    for length in (0, 10, 40, 60, len(data) - 1):
        with pytest.raises(LibraryError):
            decode(data[:length])


def test_sizes_that_do_not_fit_are_damage_even_under_a_right_checksum(library: Library) -> None:
    part = library.variants[0][0]
    for wrong in (
        replace(part, level=np.zeros(2)),
        replace(part, theta=np.zeros((0, 3)), level=np.zeros(0), slope=np.zeros((0, 3))),
    ):
        with pytest.raises(LibraryError, match="damaged"):
            decode(encode(Library("d", ((wrong,),)), NAMES[:1], CHECK, 0.0))


def test_another_format_is_told_apart_from_damage(data: bytes) -> None:
    with pytest.raises(LibraryError, match=r"not of format 1.*version that made it"):
        decode(data.replace(b"format 1\n", b"format 2\n", 1))
    with pytest.raises(LibraryError, match=r"damaged.*make it anew with `uavctl design`"):
        decode(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(LibraryError, match="no policy library"):
        decode(b"PK\x03\x04" + data)


def test_a_library_of_another_design_is_refused_with_both_names(
    design: Design, library: Library, tmp_path: Path
) -> None:
    file = tmp_path / "one.library"
    file.write_bytes(encode(replace(library, design_id="0123"), NAMES, CHECK, 0.0))
    with pytest.raises(LibraryError, match=f"one.library: .*of design 0123, not of {design.design_id}"):
        load(file, design)
    fewer = Library(design.design_id, (library.variants[0][:1],))
    part = library.variants[0][0]
    narrow = Library(design.design_id, ((replace(part, theta=part.theta[:, 1:]), library.variants[0][1]),))
    for wrong in (fewer, narrow, Library(design.design_id, library.variants * 2)):
        with pytest.raises(LibraryError, match="other components or gains"):
            check_fits(wrong, design)
    check_fits(library, design)


def test_a_file_that_is_not_there_is_told(design: Design, tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match="nowhere: No such file"):
        load(tmp_path / "nowhere", design)


def test_a_library_is_made_once_and_decides_alike_from_the_cache(design: Design, grower: Grower) -> None:
    rounds: list[tuple[str, int, float]] = []
    made = library_for(design, lambda *told: rounds.append(told))
    found = library_for(design)
    assert grower.calls == 1
    assert (made.cached, found.cached) == (False, True)
    assert made.path == found.path == cache_file(design)
    assert made.data == found.data and made.library_id == found.library_id
    assert [told[:2] for told in rounds] == [(name, count) for count in (1, 2) for name in NAMES]
    assert (made.names, made.check) == (found.names, found.check) == (NAMES, CHECK)
    one, other = (LibrarySolver(design, each.library).solve(0, START, design.target) for each in (made, found))
    assert one.inputs.tobytes() == other.inputs.tobytes() and one.cost == other.cost
    assert [file.name for file in cache_file(design).parent.iterdir()] == [cache_file(design).name]


def test_another_design_and_other_code_have_other_files(
    design: Design, grower: Grower, monkeypatch: pytest.MonkeyPatch
) -> None:
    library_for(design)
    here = cache_file(design)
    assert here.name == f"{design.design_id}-{maker_id()}.library"
    assert cache_file(replace(design, design_id="other")) != here
    monkeypatch.setattr(library_store, "maker_id", lambda: "later")
    assert cache_file(design) != here
    library_for(design)
    assert grower.calls == 2


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "flipped": lambda data: data[:-9] + bytes([data[-9] ^ 4]) + data[-8:],
    "of another format": lambda data: data.replace(b"format 1\n", b"format 0\n", 1),
}


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_file_of_the_cache_is_made_anew_and_told(design: Design, grower: Grower, how: str) -> None:
    data = library_for(design).data
    file = cache_file(design)
    file.write_bytes(DAMAGE[how](data))
    told: list[str] = []
    again = library_for(design, tell=told.append)
    assert (grower.calls, again.cached) == (2, False)
    (text,) = told
    assert str(file) in text and text.endswith("it is made anew")
    assert library_for(design, tell=told.append).cached and len(told) == 1


def test_without_a_cache_that_can_be_written_it_works_and_says_so_once(
    design: Design, grower: Grower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("UAVCTL_CACHE", str(tmp_path / "file"))
    told: list[str] = []
    stored = library_for(design, tell=told.append)
    assert (stored.path, stored.cached, stored.sizes) == (None, False, (1, 1))
    (text,) = told
    assert "made anew each time" in text and "set UAVCTL_CACHE" in text


def test_without_a_home_it_works_too(design: Design, grower: Grower, monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("UAVCTL_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", homeless)
    told: list[str] = []
    assert library_for(design, tell=told.append).path is None
    assert len(told) == 1 and "home" in told[0]


def test_where_the_cache_is(design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UAVCTL_CACHE", "/one")
    monkeypatch.setenv("XDG_CACHE_HOME", "/two")
    monkeypatch.setenv("HOME", "/three")
    assert cache_file(design).parent == Path("/one/library")
    monkeypatch.delenv("UAVCTL_CACHE")
    assert cache_file(design).parent == Path("/two/uavctl/library")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_file(design).parent == Path("/three/.cache/uavctl/library")


def test_a_failed_write_leaves_nothing_half_written(
    design: Design, grower: Grower, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    told: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        assert library_for(design, tell=told.append).path is None
    assert len(told) == 1 and "No space left on device" in told[0]
    assert list(cache_file(design).parent.iterdir()) == []
    assert library_for(design, tell=told.append).path == cache_file(design)


def test_who_finds_another_at_work_waits_for_its_library(design: Design, grower: Grower) -> None:
    grower.release.clear()
    found: list[bool] = []
    told: list[str] = []
    modes: list[int] = []

    def tell(text: str) -> None:
        told.append(text)
        modes.append(cache_file(design).with_suffix(".lock").stat().st_mode & 0o777)
        grower.release.set()  # only now, when the second one waits, may the first one end

    first = threading.Thread(target=lambda: found.append(library_for(design).cached))
    first.start()
    assert grower.begun.wait(30.0)
    second = threading.Thread(target=lambda: found.append(library_for(design, tell=tell).cached))
    second.start()
    for thread in (first, second):
        thread.join(30.0)
    assert sorted(found) == [False, True]
    assert grower.calls == 1
    assert told == ["another process is making the policy library; waiting for it"]
    assert modes == [0o600]  # no other user can keep a daemon waiting


def test_a_failed_growth_holds_up_nobody(design: Design, grower: Grower) -> None:
    grower.fails = True
    with pytest.raises(DesignError):
        library_for(design)
    grower.fails = False
    assert not library_for(design).cached
    assert [file.suffix for file in cache_file(design).parent.iterdir()] == [".library"]


def test_a_file_is_plain_data(data: bytes) -> None:
    content = data[data.index(b"\n") + 1 + 32 :]
    design_id, library_id, made_s, check, parts = msgspec.msgpack.decode(content)
    assert (made_s, len(parts), check["worst_gap"]) == (1.5, 2, 2e-5)
    assert library_id == decode(data).library_id and design_id == decode(data).library.design_id


@pytest.mark.slow
def test_a_check_counts_answers_and_finds_the_worst_gap(design: Design, library: Library) -> None:
    found = check_library(design, library, states=12)
    assert found == check_library(design, library, states=12)
    assert (found.states, sum(found.methods.values())) == (12, 12)
    assert found.methods["exact"] > 6  # one policy a component serves near the target only
    assert 0.0 <= found.worst_gap <= 1e-3
