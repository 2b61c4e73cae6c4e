"""A measured trace of losses and delays: read from a file, replayed by the channel, and what a design makes of it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from loopback_rig import lockstep

from sim.channel import Channel
from uavctl.arrays import Array
from uavctl.config import load, load_config
from uavctl.config.load import dump_config, parse
from uavctl.errors import ConfigError, DesignError
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.draws import draw
from uavctl.records import Truth
from uavctl.wiring.link import build_delayed_link, build_link, compute_promised_probability

S = 1_000_000_000
INF = math.inf
MEASURED = (0.03, INF, 0.05, 0.0, INF, INF, 0.04, 0.6)  # the last one is later than the design waits
PAPER = ["link.model=trace", "link.delay_s=0.05", "link.jitter_s=0"]


def listed(delays: tuple[float, ...]) -> str:
    return f"link.trace_s=[{', '.join(map(str, delays))}]"


def problems(*overrides: str, preset: str = "paper") -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(preset, list(overrides))
    return "\n".join(caught.value.problems)


@pytest.mark.parametrize(
    "text",
    [
        "0.03\n\n0.05\n0\ninf\n \n4e-2\n0.6\n",
        "delay_s\n0.03\ninf\n0.05\n0.0\ninf\n\n0.04\n0.6",
        "sent_s,delay_s,note\n0,0.03,a\n1,inf,b\n2,0.05,\n3,0,\n4,,lost\n5, ,\n6,0.04,\n7,0.60,x\n",
        "\ufeff0.03\r\ninf\r\n0.05\r\n0\r\n\r\ninf\r\n.04\r\n6e-1\r\n",
    ],
)
def test_a_file_gives_one_delay_a_line_nothing_or_inf_for_a_lost_packet(tmp_path: Path, text: str) -> None:
    (tmp_path / "trace.csv").write_bytes(text.encode())
    config = load_config("paper", [*PAPER, f"link.trace_file={tmp_path / 'trace.csv'}"])
    assert config.link.trace_s == MEASURED
    assert config.link.trace_file == ""
    reloaded = parse(dump_config(config), "again").config  # a recording holds the trace itself
    assert reloaded == config


def test_a_relative_name_is_beside_the_file_or_where_the_command_is_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, delay in (("beside", 0.01), ("here", 0.02)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "trace.csv").write_text(f"{delay}\n", encoding="utf-8")
    path = tmp_path / "beside" / "mine.toml"
    path.write_text(dump_config(load_config("paper")), encoding="utf-8")
    text = path.read_text(encoding="utf-8").replace('trace_file = ""', 'trace_file = "trace.csv"')
    path.write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path / "here")
    assert load_config(str(path)).link.trace_s == (0.01,)
    assert load_config(str(path), ["link.trace_file=trace.csv"]).link.trace_s == (0.02,)
    assert load_config("paper", ["link.trace_file=trace.csv"]).link.trace_s == (0.02,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1\nfast\n0.2\n", 'trace.csv:2: "fast" is not a number'),
        ("0.1\n0.2\n-0.5\n", "trace.csv:3: -0.5 is not a delay in s"),
        ("nan\n", "trace.csv:1: nan is not a delay in s"),
        ("0.1,2\n", "trace.csv:1: has 2 columns; give one, or a header"),
        ("a,delay_s\n1,0.1\n0.2\n", "trace.csv:3: has 1 columns; give as many as the header"),
        ("", "trace.csv: has no packets"),
        ("delay_s\n", "trace.csv: has no packets"),
        ("0.1\n" * 20_001, "trace.csv: has 20001 packets, more than 20000"),
        ("0.1\n" + "x\n" * 9, "trace.csv: 4 more"),
        ("inf\n\n", "trace.csv: link.trace_s: every packet is lost"),
    ],
)
def test_problems_of_a_trace_are_reported_with_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "trace.csv").write_text(text, encoding="utf-8")
    assert message in problems(*PAPER, f"link.trace_file={tmp_path / 'trace.csv'}")


def test_missing_or_binary_trace_files_are_errors(tmp_path: Path) -> None:
    assert "nowhere.csv: cannot be read" in problems(*PAPER, "link.trace_file=nowhere.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    assert "is not UTF-8 text" in problems(*PAPER, f"link.trace_file={tmp_path / 'bytes.csv'}")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["link.model=trace"], 'link.trace_file: is missing, and model "trace" needs it'),
        (["link.model=trace", "link.trace_s=[0.1, -1.0]"], "link.trace_s[1]: -1 is not a delay"),
        (["link.model=trace", "link.trace_s=[nan]"], "link.trace_s[0]: nan is not a finite number"),
        (["link.trace_s=[0.1]", "link.trace_file=x.csv"], "there are delays in link.trace_s as well"),
    ],
)
def test_an_invalid_trace_is_refused(overrides: list[str], message: str) -> None:
    assert message in problems(*overrides)


def test_the_channel_loses_and_delays_each_packet_as_the_trace_did_over_and_over_again() -> None:
    link = load_config("paper", [*PAPER, listed(MEASURED), "link.jitter_s=0.4", "link.loss=0.9"]).link
    channel = Channel(link, np.random.SeedSequence(1), 5 * S)
    for n in range(20):
        channel.push(5 * S + n * S, n.to_bytes(2, "little"))
    got = {int.from_bytes(data, "little"): at_ns - 5 * S for at_ns, data in channel.pop_due(10**18)}
    delays = {n: MEASURED[n % 8] for n in range(20) if MEASURED[n % 8] < INF}
    assert got == {n: n * S + round(delay * S) for n, delay in delays.items()}
    assert channel.counters.lost == 20 - len(delays)


def test_a_certain_packet_that_the_trace_lost_comes_at_once_and_one_not_sent_takes_its_place_in_it() -> None:
    channel = Channel(load_config("paper", [*PAPER, listed((INF, 0.25, 0.5))]).link, np.random.SeedSequence(1), 0)
    channel.push(0, b"a", is_certain=True)
    channel.skip_packet(S)
    channel.push(2 * S, b"b")
    assert channel.pop_due(10**18) == [(0, b"a"), (2 * S + S // 2, b"b")]


def test_a_flight_over_a_trace_gets_what_the_trace_lets_through() -> None:
    memory = lockstep("paper", 24.0, *PAPER, listed((0.05, 0.01, INF, 0.02)))
    truths = memory.of(Truth)
    assert [truth.lost for truth in truths] == [(k + 2) // 4 for k in range(24)]  # packet 2 and every fourth after it


def test_the_design_counts_the_trace_s_own_runs_and_late_packets_as_lost() -> None:
    link = build_link(load_config("paper", [*PAPER, listed(MEASURED)]))
    # Arrive in time: 0, 2, 3, 6. Runs after them, going round: 1, 0, 2, 1 lost.
    assert link.outage(1) == pytest.approx(4 / 8)
    assert link.age(3)[1, 1] == pytest.approx(3 / 4)
    assert link.age(3)[2, 2] == pytest.approx(1 / 4)
    assert link.age(3)[3, 3] == 0.0
    patient = load_config("paper", [*PAPER, listed(MEASURED), "link.jitter_s=0.56"])
    assert build_link(patient).outage(1) == pytest.approx(3 / 8)


def test_a_trace_without_losses_promises_everything() -> None:
    assert compute_promised_probability(build_link(load_config("paper", [*PAPER, listed((0.01, 0.02))]))) == 1.0


def test_runs_beyond_the_longest_that_a_chain_has_are_cut() -> None:
    link = build_link(load_config("paper", [*PAPER, listed((0.0, *[INF] * 500))]))
    assert link.age(99)[99, 99] == 1.0


def test_a_design_that_waits_for_none_of_the_packets_is_refused_with_the_quickest_one() -> None:
    loaded = load("paper", [*PAPER, listed((0.07, INF, 0.3))])
    with pytest.raises(DesignError, match=r"only 0\.05 s .*\(quickest: 0\.07 s\)") as caught:
        build_link(loaded.config)
    assert caught.value.key == "link.delay_s"


def test_delays_of_a_step_and_more_are_for_independent_losses_only() -> None:
    with pytest.raises(DesignError, match="independent losses only"):
        build_delayed_link(load_config("paper", [*PAPER, listed(MEASURED), "link.delay_s=1.5"]))


def known(delays: Array, dt_s: float) -> list[int]:
    """Newest capture known at each step, by going through the packets: late ones by whole steps, rounded up."""
    is_within_step = max(delay for delay in MEASURED if delay < INF) < dt_s
    captures, best = [], 0
    for k in range(len(delays)):
        for j in range(k + 1):
            delay_steps = (
                0 if is_within_step or j == 0 else math.ceil(delays[j] / dt_s - 1e-9) if delays[j] < INF else 10**6
            )
            if (delays[j] < INF or j == 0) and j + delay_steps <= k:
                best = max(best, j)
        captures.append(best)
    return captures


@pytest.mark.parametrize("dt_s", [1.0, 0.25])
def test_runs_of_a_campaign_begin_at_drawn_packets_and_follow_the_trace(dt_s: float) -> None:
    link = load_config("paper", [*PAPER, listed(MEASURED)]).link
    chances = draw(3, 0, 200, 20, 1).link
    captures = compute_newest_captures(link, dt_s, chances)
    first = (chances[:, 0, 0] * 8).astype(int)
    assert set(first) == set(range(8))
    for run in range(200):
        delays = np.array([MEASURED[(first[run] + k) % 8] for k in range(20)])
        assert captures[run].tolist() == known(delays, dt_s)
