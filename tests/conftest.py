"""What a test run needs as a whole: what is collected only when asked for, and in which order."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

from uavctl.arithmetic import ARITHMETIC  # loaded before numpy, so that tests compute as the commands do

if TYPE_CHECKING:
    from logs.recording.summary import FlightSummary

# Most of a run's time. They begin, so that no worker is left alone with one of them in the end.
LONGEST = (
    "test_manual", "test_tune_cmd", "test_endings", "test_operation", "test_faults_truth", "test_take_off_failsafes",
    "test_tune_real", "test_closed_loop", "test_soak", "test_properties", "test_whatif_inertial", "test_conditioned",
    "test_recorded_flights", "test_extending", "test_relay_clock", "test_observer", "test_relay_outlives",
    "test_tune", "test_inertial_faults",
    "test_campaign_cmd", "test_general_plants", "test_identify", "test_faults_storage", "test_bias", "test_python_docs",
    "test_inertial_errors", "test_late", "test_whatif", "test_fly", "test_report", "test_loopback", "test_cuts",
    "test_foreign_stream", "test_engagement", "test_check_cmd", "test_conic", "test_campaign_docs",
    "test_sim_quadrotor_peers", "test_shortcut", "test_policy", "test_hand_over_restart", "test_whatif_cmd",
    "test_campaign_trials", "test_identify_jerk", "test_daemon", "test_sources", "test_scaling", "test_trial_fly",
    "test_campaign_positions", "test_report_figures", "test_flight_mission", "test_trial_position_loop",
    "test_natnet_flight", "test_config_bounds", "test_bench", "test_paper_cmd",
    "test_reference_backoffs", "test_preview", "test_relay", "test_conditioned_flight",
    "test_replay", "test_difference", "test_conditioned_design", "test_foreign", "test_flat",
    "test_sim_autopilot_bytes", "test_sim_fuzz", "test_synthesis", "test_campaign_world", "test_loop",
    "test_check_axes", "test_take_off", "test_replay_soak", "test_foreign_ros", "test_paper_depth",
    "test_viewers", "test_sealed", "test_sim_observed",
)  # fmt: skip

# Objects, and collections of younger ones, before the garbage collector looks. By Python's own 700, 10 and 10 it looks
# 1000 times in 15 s of flights, most often at what lives on. 100,000 objects are some 20 MB.
GARBAGE = (100_000, 20, 20)


def pytest_report_header() -> str:
    return f"arithmetic: {ARITHMETIC}"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    # Real clients and nodes of ROS 2 need interpreters of their own: `make test-clients`, `make test-ros2`.
    name = collection_path.name
    return True if name in ("clients", "ros2") and not any(name in argument for argument in config.args) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect without the garbage collector, which never looks at what was collected: it stays until the end.

    Later it seldom looks: records and messages are many, and hardly one of them is in a cycle.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(*GARBAGE)
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """Nothing here cuts the power, and without that nobody can see whether a file has reached the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _flights_share_what_they_need() -> Iterator[None]:
    """Flights of equal configurations share these, a design and its solver.

    And no flight collects garbage among all that the tests' process holds: test_realtime.py does.
    """
    from shared_designs import share_configurations, share_designs

    @contextmanager
    def leave_garbage() -> Iterator[Any]:
        yield SimpleNamespace(after_tick=lambda ticked, lateness_ns: None)

    with pytest.MonkeyPatch.context() as patch:
        share_configurations(patch)
        share_designs(patch)
        for command in ("services", "loopback"):
            patch.setattr(f"uavctl.cli.{command}.control_garbage_collection", leave_garbage)
        yield


@pytest.fixture(autouse=True)
def _failures_are_seen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails in a flight fails the test too, though the flight itself goes on or ends in order."""

    def fail(loop: object, text: str, at_ns: int) -> None:
        raise sys.exc_info()[1] or AssertionError(text)

    # By its name: the process that hands the tests out, and runs none, would load all that flies.
    if "control_may_fail" not in request.fixturenames:
        monkeypatch.setattr("uavctl.loop.ControlLoop._fail", fail)
        monkeypatch.setattr("uavctl.loop.ControlLoop._make_error_event", fail)


@pytest.fixture(autouse=True)
def _no_alarm_is_left() -> Iterator[None]:
    """A second signal limits the time to the end of the process, and the test's process goes on."""
    yield
    signal.alarm(0)


@pytest.fixture
def control_may_fail() -> None:
    """For tests of what happens when the controller, or what is beside it, fails."""


@pytest.fixture(scope="session", autouse=True)
def _pages_are_drawn_here() -> Iterator[None]:
    """Here, and without their figures, at which tests/logs/report looks: tests of flights read what a page says.

    A process for each would load matplotlib again and again; test_loopback.py draws one as it is. For the session, so
    that the flights of fixtures have theirs drawn here, too.
    """

    def draw(path: Path, summary: FlightSummary, page: Path) -> None:
        from report_rig import omit_figures

        from logs.recording.flight import FlightData
        from logs.recording.reader import read
        from logs.report.flight_page import write_report

        with omit_figures():
            write_report(FlightData.from_records(read(path), path), summary, page)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavctl.cli.flying.draw_page", draw)
        yield


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """For flights whose page nobody reads: drawing one takes longer than to fly."""
    monkeypatch.setattr("uavctl.cli.flying.draw_page", lambda *_: None)


def pytest_configure() -> None:
    settings.register_profile("patient", deadline=None)  # how long an example takes is the machine's affair
    # For `make test`, of which a person runs many: `make test-all` asks four times as many examples of each property.
    settings.register_profile("quick", deadline=None, max_examples=25)
    settings.load_profile("patient")
