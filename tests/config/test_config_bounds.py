"""What is beyond all bounds is refused with its place before work begins: depths, lengths, magnitudes, files."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from config_mutants import CONFIG, Case, Mutants, find_ranges, load_bases
from hypothesis import given
from hypothesis import strategies as st
from work_rig import limit_memory

from uavctl.cli.app import run
from uavctl.config import Config, document, dump_config, link, load, load_config, mission, parse
from uavctl.config.document import (
    MAX_BYTES,
    MAX_DEPTH,
    MAX_LIST_LENGTH,
    MAX_ROW_LENGTH,
    MAX_TEXT_LENGTH,
    MAX_TOKEN_LENGTH,
    MAX_TRAJECTORY_SAMPLES,
    MAX_VALUES,
    DataFileError,
    find_excess,
    find_key_lines,
    read_text,
)
from uavctl.config.link import MAX_TRACE_PACKETS
from uavctl.config.load import parse_stored_toml
from uavctl.config.mission import TrajectoryConfig
from uavctl.errors import ConfigError
from uavctl.lab.campaign.spec import read_campaign

PAPER = dump_config(load_config("paper"))
SEED, CONFIGS, LINES = 7, 60, 80
FENCE = '[[fence]]\nstate = "north"\nside = "upper"\ntimes_s = [0.0]\nvalues = [20.0]\n'


def told(text: str, *overrides: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        parse(text, "my.toml", overrides)
    return caught.value.problems


@pytest.mark.parametrize("brackets", ["[]", "{}"])
@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 500, 200_000])
@pytest.mark.fault(33)
def test_deep_nesting_is_refused_with_its_line(brackets: str, depth: int) -> None:
    opened = brackets[0] if brackets == "[]" else "{a="
    text = PAPER + f"\n[extra]\ndeep = {opened * depth}1{brackets[1] * depth}\n"
    (problem,) = told(text)
    line = text.splitlines().index("[extra]") + 2
    assert problem.startswith(f"my.toml:{line}: ") and f"more than {MAX_DEPTH} deep" in problem


@pytest.mark.parametrize("value", ["[" * 5000 + "]" * 5000, "{a=" * 5000 + "1" + "}" * 5000])
def test_deep_nesting_of_an_override_is_refused(value: str) -> None:
    (problem,) = told(PAPER, f"link.loss={value}")
    assert problem.startswith("--set link.loss=") and "deep" in problem


@pytest.mark.parametrize("parts", [MAX_DEPTH + 1, 3000])
def test_dotted_keys_are_as_deep_as_brackets(parts: int) -> None:
    path = ".".join("a" * parts)
    assert "deep" in told(f"{path} = 1\n" + PAPER)[0]
    assert "deep" in told(PAPER, f"{path}=1")[0]


def test_brackets_in_strings_and_comments_are_none() -> None:
    assert find_excess(f'a = "{"[" * 50}"\nb = \'{"{" * 50}\'\n# {"[" * 50}\nc = """\n{"[" * 50}"""\n') is None
    assert find_excess("a = [\n" * (MAX_DEPTH + 1)) == (
        MAX_DEPTH + 1,
        f"brackets are nested more than {MAX_DEPTH} deep, or not closed",
    )


def test_long_texts_are_refused_before_they_are_read_as_toml() -> None:
    (problem,) = told(f'name = "{"a" * MAX_BYTES}"\n')
    assert problem.startswith("my.toml:1: ") and "characters" in problem
    (problem,) = told("a = 1\n" * (MAX_VALUES + 1))  # a key that is there twice, were it read
    assert f"more than {MAX_VALUES}" in problem


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("estimator.position_std_m=1e300", "estimator.position_std_m"),
        ("link.delay_s=1e9", "link.delay_s"),
        (f'name="{"a" * 2000}"', "name"),
        ('name="a\\u001b[2J"', "name"),
        (f"mission.waypoints=[{'[0,0,-1],' * 1001}]", "mission.waypoints"),
        (f"mission.waypoints=[{'[0,0,-1],' * (MAX_LIST_LENGTH + 1)}]", "mission.waypoints"),
        ("daemon.tick_s=1e-9", "daemon.tick_s"),
        ("plant.dt_s=1e6", "plant.dt_s"),
        (f"sim.seed={2**70}", "sim.seed"),
        (f"sim.seed=0x{'f' * 5000}", "sim.seed"),
        ("sets.state_upper=[1e300,8,50,8]", "sets.state_upper[0]"),
        ("link.trace_s=[1e9]", "link.trace_s[0]"),
        ("cost.input=[1e300,1]", "cost.input[0]"),
        ("sim.camera.rate_hz=1e9", "sim.camera.rate_hz"),
    ],
)
@pytest.mark.fault(33)
def test_what_no_key_takes_is_told_with_the_key(override: str, key: str) -> None:
    model = ("link.model=trace",) if "trace_s" in override else ()
    problems = told(PAPER, *model, override)
    assert any(f": {key}: " in problem for problem in problems), problems


def test_numbers_of_thousands_of_digits_are_refused() -> None:
    assert told(PAPER + f"\n[x]\ny = {'9' * 5000}\n")[0].startswith("my.toml:")


@pytest.mark.fault(33)
def test_more_fences_than_a_flight_has_are_refused_at_once() -> None:
    most = PAPER.replace("fence = []\n", "") + FENCE * 50
    assert len(parse(most, "my.toml").config.fence) == 50
    assert "fence: has 51 tables; give at most 50" in told(most + FENCE)[0]


def test_a_tick_that_divides_no_step_is_refused_after_few_tries() -> None:
    # 4.999999937 s is 4999999937 ns, whose only divisors are large: no tick of a millisecond or more divides it.
    problems = told(PAPER, "plant.dt_s=4.999999937", "daemon.tick_s=0.001")
    assert any("daemon.tick_s: 0.001 s does not divide" in problem for problem in problems)


def test_many_unknown_keys_are_told_in_short() -> None:
    problems = told("\n".join(f"key{i} = 1" for i in range(5000)) + "\n" + PAPER)
    assert len(problems) < 20 and any("5000 in all" in problem for problem in problems)


def test_a_longest_trace_and_motion_still_make_a_configuration_that_can_be_read_back() -> None:
    config = load_config("paper")
    places = tuple((i / 3.0e-3 % 20.0, -i / 7.0e-3 % 20.0, 0.1 / 3.0) for i in range(MAX_TRAJECTORY_SAMPLES))
    motion = TrajectoryConfig(
        times_s=tuple(i / 3.0 for i in range(MAX_TRAJECTORY_SAMPLES)), positions_m=places, velocities_mps=places
    )
    trace = tuple(0.1 / 3.0 + i * 1e-9 / 3.0 for i in range(MAX_TRACE_PACKETS))
    config = msgspec.structs.replace(
        config,
        mission=msgspec.structs.replace(config.mission, trajectory=motion),
        link=msgspec.structs.replace(config.link, model="trace", trace_s=trace),
    )
    assert find_excess(dump_config(config)) is None


def test_every_number_has_a_range() -> None:
    found = dict(find_ranges(Config))
    assert len(found) > 90
    unbounded = [path for path, (low, high, _) in found.items() if not -1e16 < low < high < 1e16]
    assert unbounded == []


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 5000])
def test_a_campaign_that_nests_deep_is_refused(depth: int, tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'name = "deep"\ndeep = {"[" * depth}{"]" * depth}\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=f"c.toml:2: brackets are nested more than {MAX_DEPTH} deep"):
        read_campaign(path)


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """A pipe that nobody writes to."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    return path


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null"])
def test_devices_are_not_read(device: str) -> None:
    with pytest.raises(DataFileError, match="pipe or a device"):
        read_text(Path(device))
    with pytest.raises(ConfigError, match="pipe or a device"):
        load(device)


def test_a_pipe_is_not_waited_for(pipe: Path) -> None:
    for read in (read_text, read_campaign):
        with pytest.raises((DataFileError, ConfigError), match="pipe or a device"):
            read(pipe)
    with pytest.raises(ConfigError, match=r"mission\.trajectory\.file: .*pipe or a device"):
        load("paper", [f"mission.trajectory.file={pipe}"])
    assert run(["log", "info", str(pipe)]) == 2


def test_a_long_file_is_read_up_to_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    path.write_bytes(b"0" * (MAX_BYTES + 1))
    with pytest.raises(DataFileError, match=f"longer than {MAX_BYTES}"):
        read_text(path)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (
            ["0,1,1,-1"] * (MAX_TRAJECTORY_SAMPLES + 1),
            f"has {MAX_TRAJECTORY_SAMPLES + 1} rows, more than {MAX_TRAJECTORY_SAMPLES}",
        ),
        (["0,1,1,-1", "1,1e300,1,-1"], "motion.csv:2: 1e+300 is beyond 1e+07"),
        (["0,1,1,-1", "1e6,1,1,-1"], "times_s: the last one is 1e+06 steps"),
        (["0,1,1,-1", f"1,{'9' * 9000},1,-1"], "is not a finite number"),
    ],
)
def test_a_motion_from_a_file_is_bounded_as_one_in_the_table(rows: list[str], told: str, tmp_path: Path) -> None:
    (tmp_path / "motion.csv").write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load("paper", [f"mission.trajectory.file={tmp_path / 'motion.csv'}"])
    assert any(told in problem and len(problem) < 400 for problem in caught.value.problems), caught.value.problems


def test_keys_of_the_policy_library_are_named_with_what_to_do() -> None:
    assert "solver.exact: unknown key" in told(PAPER, "solver.exact=true")[0]
    assert "solver.method: the policy library is gone; remove the key" in told(PAPER, 'solver.method="library"')[0]
    assert parse(PAPER, "my.toml", ["smpc.horizon=25"]).config.smpc.horizon == 25


# --- command lines ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ["loopback", "--duration", "1e300"],
        ["loopback", "--duration", "nan"],
        ["loopback", "--seed", "-1"],
        ["loopback", "--seed", "9" * 30],
        ["loopback", "--arm", "--takeoff", "inf"],
        ["fly", "--duration", "1e300"],
        ["fly", "--live", "--live-port", "99999"],
        ["check", "--seconds", "nan"],
        ["paper", "--runs", "9" * 20],
        ["paper", "--steps", "9" * 20],
        ["bench", "--states", "9" * 20],
        ["design", "--config", "a" * 5000],
        ["design", "--set", "a=" + "b" * 100_000],
        ["log", "info", "a" * 5000],
        ["log", "compare", "a" * 5000, "b"],
    ],
)
def test_odd_values_are_refused_in_one_short_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1 and len(told) < 1200


def test_what_is_told_does_not_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["design", "--set", "a\nb\x1b[2J\u202e=1"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "\x1b[2J" not in told and "\u202e" not in told and r"\x1b[2J" in told


def test_a_campaign_is_bounded_by_its_product(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    tables = "".join(f'[[controller]]\nname = "{i}"\nkind = "lqg"\n[[link]]\nname = "l{i}"\n' for i in range(100))
    many = "".join(f'[[disturbance]]\nname = "{i}"\n' for i in range(10))
    path.write_text('name = "big"\nconfig = "paper"\nsteps = 100000\n' + tables + many, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_campaign(path)
    told = "\n".join(caught.value.problems)
    assert "10000 designs" in told and "100000 cells" in told and "steps: 100000 steps of 1000 runs" in told


# --- a slice of tools/fuzz_config.py ---------------------------------------------------------------------------------


def lay_out(case: Case, folder: Path) -> None:
    for name, content in case.files.items():
        if content is None:
            os.mkfifo(folder / name)
        else:
            data = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
            (folder / name).write_bytes(data)


def quick(words: list[str]) -> list[str]:
    """The same configuration without a flight or a socket."""
    if words[0] not in ("design", "solve"):
        given = [word for pair in pairwise(words) if pair[0] == "--set" for word in pair]
        words = ["design", "--config", CONFIG, *given]
    return words


@pytest.mark.slow
def test_a_slice_of_spoilt_configurations_ends_in_an_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mutants, codes = Mutants(SEED, load_bases()), set()
    for number in range(CONFIGS):
        case, folder = mutants.config(number), tmp_path / str(number)
        folder.mkdir()
        lay_out(case, folder)
        monkeypatch.chdir(folder)
        if CONFIG in case.files:
            codes.add(run(quick(case.words)))  # whatever escapes is the finding
            told = capsys.readouterr().err
            assert re.fullmatch(r"(error: .{1,1100}\n(.{1,1100}\n)*)?", told), (number, case.note)
    assert codes <= {0, 1, 2} and {0, 2} <= codes


def test_a_slice_of_spoilt_command_lines_ends_in_an_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mutants, codes = Mutants(SEED, load_bases()), set()
    for number in range(LINES):
        case, folder = mutants.command_line(number), tmp_path / str(number)
        if case.words[0] in ("design", "solve", "log", "ctl", "key"):
            folder.mkdir()
            lay_out(case, folder)
            monkeypatch.chdir(folder)
            codes.add(run(case.words))
    capsys.readouterr()
    assert codes <= {0, 1, 2} and 2 in codes


@pytest.mark.parametrize("preset", ["room", "paper"])  # of three axes, and of two
@pytest.mark.parametrize("key", ["input_lower", "input_upper"])
def test_input_limits_that_leave_zero_out_are_refused(
    preset: str, key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The limit of each input alone is moved to the other side of zero."""
    limits = [float(one) for one in getattr(load_config(preset).sets, key)]
    for index in range(len(limits)):
        moved = [-0.25 * one if i == index else one for i, one in enumerate(limits)]
        assert run(["design", "--config", preset, "--json", "--set", f"sets.{key}={moved}"]) == 2
        error = json.loads(capsys.readouterr().out)
        assert "sets.input_" in error["message"]


# --- time and memory -------------------------------------------------------------------------------------------------

QUOTED = st.text(alphabet="\"'\\\n#[a.= ", max_size=60)


@pytest.mark.fault(33)
def test_a_parser_never_sees_a_key_of_many_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(f"{len(text)} characters went to the parser")

    monkeypatch.setattr("tomllib.loads", refuse)
    for key in ("x." * 10_000 + "a", "'x'." * 10_000 + "a", "x . " * 10_000 + "a"):
        for text in (f"\n{key} = 1\n", f"\n[{key}]\n", f"\na = {{{key} = 1}}\n"):
            assert told(text) == (f"my.toml:2: a dotted key is nested more than {MAX_DEPTH} deep; correct the file",)


@pytest.mark.fault(33)
def test_parts_of_dotted_keys_are_counted() -> None:
    numbers = "a = 1.5\n" * (MAX_VALUES // 2)
    assert find_excess(numbers) is None
    lines = MAX_VALUES // 5 + 2
    excess = find_excess(numbers + "[a.b.c.d.e]\n" * lines)
    assert excess is not None and MAX_VALUES // 2 < excess[0] <= MAX_VALUES // 2 + lines


@given(QUOTED)
def test_no_quote_is_looked_at_twice(text: str) -> None:
    # A pattern that fails at a quote has gone on to the end of the text, and begins again at the next one.
    for at, letter in enumerate(text):
        if letter in "\"'":
            assert document._MARK.match(text, at) is not None


@given(st.text(alphabet="[]()a ,", max_size=60))
def test_no_cell_of_a_header_is_looked_at_twice(text: str) -> None:
    for at, letter in enumerate(text):
        if letter not in ", ":
            assert mission._HEADER_CELL.match(text, at) is not None


@pytest.mark.parametrize("read", [link._read_delays, mission._read_rows])
def test_rows_beyond_all_bounds_are_not_taken_apart(read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("1" + ",1" * 20 + "\n" + ("1" + ",1" * 20 + "\n") * 60_000, encoding="utf-8")
    with limit_memory(8 * path.stat().st_size), pytest.raises(DataFileError, match="has 60001 "):
        read(path)


@pytest.mark.parametrize("read", [link._read_delays, mission._read_rows])
@pytest.mark.parametrize("text", ["x,", "1,", "t[ ", "# t"])
def test_a_line_longer_than_a_row_is_not_taken_apart(read: Callable[[Path], object], text: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("\n" + text * 500_000 + "\n0,0,0,0\n", encoding="utf-8")
    with limit_memory(8 * path.stat().st_size), pytest.raises(DataFileError) as caught:
        read(path)
    (reason,) = caught.value.reasons
    assert reason.startswith(f"{path}:2: ") and f"more than {MAX_ROW_LENGTH}" in reason


@pytest.mark.parametrize(
    "value",
    [
        "1" * 1_000_000,
        "0x" + "f" * 1_000_000,
        "0." + "1" * 1_000_000,
        "1_" * 500_000 + "1",
        '"' + "\\u0041" * 150_000 + '"',
        '"""' + '"" x' * 250_000 + '"""',
        '"""' + '\\"' * 500_000,
        '"' + "a" * 1_000_000,
        "'" + "a" * 1_000_000 + "'",
    ],
    ids=lambda value: value[:6],
)
def test_a_long_number_or_text_is_refused_before_memory_is_taken_for_it(value: str) -> None:
    text = f"name = 'a'\na = {value}\n"
    with limit_memory(6 * len(text)), pytest.raises(ConfigError) as caught:
        parse(text, "my.toml", ())
    (problem,) = caught.value.problems
    assert problem.startswith("my.toml:2: ") and f"more than {MAX_TOKEN_LENGTH}" in problem


@pytest.mark.parametrize("key", ["a" * MAX_TOKEN_LENGTH, '"' + "\\U00000041" * MAX_TEXT_LENGTH + '"'])
def test_the_longest_token_is_read(key: str) -> None:
    assert find_excess(f"a = 1 #{'-' * 20_000}\n{' ' * 20_000}{key} = 1 {' ' * 20_000}\n") is None
    assert find_excess(f"b.{'a' * (MAX_TOKEN_LENGTH + 1)}") == (1, document._describe_long_token("a" * 12_001))


def test_a_long_table_name_is_not_kept_for_each_of_its_keys() -> None:
    text = f"[{'k' * 20_000}]\n" + "".join(f"a{i} = 1\n" for i in range(1000))
    with limit_memory(100 * len(text)):
        find_key_lines(text)


def test_the_configuration_in_a_recording_has_the_same_bounds() -> None:
    for text in ("x." * 10_000 + "a = 1", "a = " + "[" * 5000 + "]" * 5000, f"a = '{'x' * 5000}'", "a = " + "1" * 5000):
        with pytest.raises(ConfigError, match=r"^header"):
            parse_stored_toml(text, "header")
    assert parse_stored_toml(PAPER, "header")["name"]
