"""One cache of policy libraries for a whole test run, what is collected only when asked for, and in which order."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.summary import FlightSummary
from logs.report.flight_page import write_report
from uavctl.loop import ControlLoop

CACHE = "UAVCTL_CACHE"
OWN = pytest.StashKey[str]()
# Most of a run's time. They begin, so that no worker is left alone with one of them in the end.
LONGEST = (
    "test_closed_loop", "test_operation", "test_campaign_cmd", "test_properties", "test_soak", "test_general_plants",
    "test_report", "test_sim_quadrotor_peers", "test_identify", "test_whatif", "test_late", "test_conic",
    "test_library_solver", "test_fly", "test_check_cmd", "test_sources", "test_policies", "test_paper_cmd",
    "test_scaling", "test_bench", "test_whatif_cmd", "test_faults_storage", "test_hand_over_restart",
    "test_foreign_stream", "test_bench_loop", "test_natnet_flight", "test_engagement", "test_outlook", "test_viewers",
    "test_loopback", "test_relay", "test_take_off", "test_linear_world_flight", "test_check_axes", "test_synthesis",
)  # fmt: skip


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    # Real clients need interpreters of their own: `make test-clients`.
    asked = any("clients" in argument for argument in config.args)
    return True if collection_path.name == "clients" and not asked else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """Nothing here cuts the power, and without that nobody can see whether a file has reached the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def _failures_are_seen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails in the controller fails the test too, though in flight the positions for the vehicle go on."""

    def fail(loop: ControlLoop, error: Exception, at_ns: int) -> None:
        raise error

    if "control_may_fail" not in request.fixturenames:
        monkeypatch.setattr(ControlLoop, "_die", fail)


@pytest.fixture
def control_may_fail() -> None:
    """For tests of what happens when the controller fails."""


@pytest.fixture(autouse=True)
def _pages_are_drawn_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process for each would load matplotlib again and again; test_loopback.py draws one as it is."""

    def draw(path: Path, summary: FlightSummary, page: Path) -> None:
        write_report(FlightData.from_records(read(path), path), summary, page)

    monkeypatch.setattr("uavctl.cli.flying.draw_page", draw)


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """For flights whose page nobody reads: drawing one takes longer than to fly."""
    monkeypatch.setattr("uavctl.cli.flying.draw_page", lambda *_: None)


def pytest_configure(config: pytest.Config) -> None:
    settings.register_profile("patient", deadline=None)  # how long an example takes is the machine's affair
    settings.load_profile("patient")
    # Workers inherit the variable from the process that starts them; a cache that somebody chose is kept.
    if CACHE not in os.environ:
        config.stash[OWN] = os.environ[CACHE] = tempfile.mkdtemp(prefix="uavctl-test-cache-")


def pytest_unconfigure(config: pytest.Config) -> None:
    own = config.stash.get(OWN, None)
    if own is not None:
        shutil.rmtree(own, ignore_errors=True)
        del os.environ[CACHE]
