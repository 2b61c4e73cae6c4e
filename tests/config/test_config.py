"""Configuration: decoding, overrides, and every problem told at once with its place."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT

from uavctl.config import Config, describe_design_error, dump_config, load, load_config, parse, presets
from uavctl.config.document import find_key_lines
from uavctl.config.load import parse_recorded
from uavctl.config.mission import FenceConfig
from uavctl.config.types import SmpcConfig
from uavctl.errors import ConfigError, DesignError
from uavctl.wiring.controller import build_spec

PAPER = (ROOT / "uavctl" / "presets" / "paper.toml").read_text(encoding="utf-8")


def problems(text: str, *overrides: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        parse(text, "my.toml", overrides)
    return caught.value.problems


def line_of(text: str, start: str) -> int:
    return next(number for number, line in enumerate(text.splitlines(), 1) if line.startswith(start))


def changed(old: str, new: str) -> str:
    assert PAPER.count(old) == 1
    return PAPER.replace(old, new)


def test_presets_load_and_have_the_numbers_of_the_paper() -> None:
    assert presets() == ("paper", "room", "room-ardupilot", "room-hahn-stursberg", "room-px4")
    paper = load_config("paper")
    assert paper.plant.a[0] == (1.0, 0.79, 0.0, 0.0)
    assert (paper.smpc.horizon, paper.smpc.tau, paper.schedule.delays) == (12, 4, 5)
    assert load_config("room-hahn-stursberg").plant.axes == ("north", "east", "down")


def test_a_file_is_the_same_as_the_preset(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(PAPER, encoding="utf-8")
    assert load_config(str(file)) == load_config("paper")


@pytest.mark.parametrize("preset", ["paper", "room-hahn-stursberg"])
def test_dumped_text_gives_an_equal_configuration(preset: str) -> None:
    config = load_config(preset, ["link.blackout=[[1, 2.5]]", "link.loss=0.1", "estimator.position_std_m=1e-7"])
    assert parse(dump_config(config), "dump").config == config


@pytest.mark.slow
@given(name=st.text(max_size=100), numbers=st.lists(st.floats(min_value=0.0) | st.just(math.inf), min_size=1))
@settings(max_examples=50)
def test_any_text_and_any_number_is_dumped_as_it_is(name: str, numbers: list[float]) -> None:
    config = load_config("paper")
    link = msgspec.structs.replace(config.link, trace_s=tuple(numbers), blackout=((0.0, 5e-324), (1e6, 9999999.9)))
    fence = (FenceConfig(state=name, side="upper", times_s=(0.0,), values=(1e-7,)),) * 2
    config = msgspec.structs.replace(config, name=name, link=link, fence=fence)
    table = tomllib.loads(dump_config(config))
    assert msgspec.convert(table, Config) == config


def test_overrides_take_toml_values_bare_strings_and_the_last_one_wins() -> None:
    config = load_config(
        "paper",
        [
            "link.loss=0.5",
            "link.loss = 0.25",
            "schedule.rule=greedy",
            'daemon.vehicle="udpin://127.0.0.1:1"',
            "daemon.mocap=udpin://127.0.0.1:2",
            "link.blackout=[[20, 40]]",
            "fallback={brake_gain_1ps = 2.0}",
        ],
    )
    assert config.link.loss == 0.25
    assert config.schedule.rule == "greedy"
    assert (config.daemon.vehicle, config.daemon.mocap) == ("udpin://127.0.0.1:1", "udpin://127.0.0.1:2")
    assert config.link.blackout == ((20.0, 40.0),)
    assert (config.fallback.brake_gain_1ps, config.fallback.recover_samples) == (2.0, 3)


OF_THE_PAPER = ("tau = 4", "delta_u = 0.9", "delta_tau = 0.99", "k_tau = [[", "offset_weight", "[schedule]", "delays")


def without_the_paper_s(text: str) -> str:
    lines = [line for line in text.splitlines() if not line.startswith((*OF_THE_PAPER, 'rule = "fixed"'))]
    return "\n".join(lines)


def test_what_the_paper_s_scheme_alone_needs_need_not_be_given_for_the_other_one() -> None:
    text = without_the_paper_s(PAPER)
    told = problems(text, "smpc.scheme=hahn-stursberg")
    keys = ("smpc.tau", "smpc.delta_u", "smpc.delta_tau", "smpc.k_tau", "smpc.offset_weight")
    assert [one.partition(": ")[2].split(": ")[0] for one in told] == [*keys, "schedule"]
    assert told[-1].endswith("schedule: missing table; add [schedule]; the presets are complete examples")
    config = parse(text, "my.toml", ["smpc.scheme=age-conditioned", "smpc.horizon=48"]).config
    assert config.smpc.tau is None and config.smpc.k_tau is None
    assert parse(dump_config(config), "again.toml").config == config
    with pytest.raises(DesignError, match="is missing") as caught:
        build_spec(config)
    assert caught.value.key == "smpc.tau"


def test_what_the_paper_s_scheme_needs_is_passed_over_where_it_is_given_to_the_other_one() -> None:
    odd = ["smpc.horizon=48", "smpc.tau=20", "smpc.k_tau=[[1.0]]", "schedule.delays=[0,1]", "schedule.rule=search"]
    assert load_config("paper", ["smpc.scheme=age-conditioned", *odd]).smpc.tau == 20
    with pytest.raises(ConfigError, match=r"smpc\.k_tau"):
        load_config("paper", odd)


@pytest.mark.fault(33)
@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ("horizon = 12", "horizn = 12", "smpc.horizn", 'unknown key (nearest valid name "horizon")'),
        ("horizon = 12", "", "smpc.horizon", "missing key"),
        ("horizon = 12", 'horizon = "12"', "smpc.horizon", 'expected a whole number, got "12"'),
        ("horizon = 12", "horizon = 1", "smpc.horizon", "expected a whole number >= 2, got 1"),
        ("horizon = 12", "horizon = 41", "smpc.horizon", "41 steps are more than planned feedback is solved for, 40"),
        ("horizon = 12", "horizon = 101", "smpc.horizon", "expected a whole number <= 100, got 101"),
        ("tau = 4", "", "smpc.tau", "missing key; add it: whole number (>= 1, <= 20), delay τ"),
        ("tau = 4", 'tau = "4"', "smpc.tau", 'expected a whole number, got "4"'),
        ("delta_u = 0.9", "", "smpc.delta_u", "missing key; add it: number (> 0, < 1), likelihood δ_u"),
        ("delta_tau = 0.99", "", "smpc.delta_tau", "missing key"),
        ("delta_tau = 0.99", "delta_tau = 1", "smpc.delta_tau", "expected a number < 1.0, got 1"),
        ("k_tau = ", "# ", "smpc.k_tau", "missing key; add it: list of lists of numbers"),
        ("offset_weight = ", "# ", "smpc.offset_weight", "missing key"),
        ("horizon = 12", "horizon = 4", "smpc.tau", "4 steps do not fit into the horizon of 4"),
        ("loss = 0.3", "loss = 1.0", "link.loss", "expected a number < 1.0, got 1.0"),
        ("loss = 0.3", "loss = nan", "link.loss", "nan is not a finite number"),
        ("loss = 0.3", "delay_s = inf", "link.delay_s", "inf is not a finite number"),
        ("loss = 0.3", "blackout = [[5, 9], [7, 6]]", "link.blackout[1]", "[7, 6] is not a span of time"),
        ('rule = "fixed"', 'rule = "serch"', "schedule.rule", '"serch" is not a choice (nearest valid name "search")'),
        ('rule = "fixed"', 'rule = "search"', "schedule.search_states", 'rule "search" needs it'),
        ("delays = 5", "delays = [5, 5]", "schedule.delays", "has 2 entries, smpc.horizon = 12"),
        ("delays = 5", "delays = 0", "schedule.delays", "a delay is below 1 step"),
        ("tick_s = 0.1", "tick_s = 0.03", "daemon.tick_s", "0.03 s does not divide plant.dt_s = 1 s"),
        ("[[0.6, 0.0], [0.0, 0.6]]", "[[0.6, 0.1], [0.0, 0.6]]", "plant.w", "is not symmetric"),
        ("[[0.6, 0.0], [0.0, 0.6]]", "[[0.6, 0.7], [0.7, 0.6]]", "plant.w", "not positive semidefinite (smallest"),
        ("[[0.6, 0.0], [0.0, 0.6]]", "[[0.6, 0.0], [0.6]]", "plant.w", "rows have different lengths (1, 2)"),
        ("[[0.6, 0.0], [0.0, 0.6]]", "[[0.6]]", "plant.e", "is 4 x 2, n_x x n_w = 4 x 1"),
        ("b = [[0.21, 0.0], ", "b = [", "plant.b", "is 3 x 2, n_x x number of axes = 4 x 2"),
        ("k_tau = [[-0.058, ", "k_tau = [[", "smpc.k_tau", "rows have different lengths (3, 4)"),
        ("position_index = [0, 2]", "position_index = [0, 4]", "plant.position_index", "a state that is not there"),
        ("velocity_index = [1, 3]", "velocity_index = [1, 2]", "plant.velocity_index", "a state is named twice"),
        ('["north", "east"]', '["east", "north"]', "plant.axes", "turns round"),
        ("dt_s = 1.0", "dt_s = 1.0\nlag_s = [0.1, 0.1]", "plant.lag_s", 'no meaning with model "matrices"'),
        ("state_lower = [-30.0, -8.0,", "state_lower = [-30.0, 7.0,", "sets.state_lower[1]", "7 is not below"),
        ("input_upper = [7.5, 7.5]", "input_upper = [7.5]", "sets.input_upper", "has 1 entries, number of axes = 2"),
        ("state = [10.0, 0.1, 10.0, 0.1]", "state = [-1, 0, 1, 0]", "cost.state[0]", "expected a number >= 0.0"),
        ("input = [0.1, 0.1]", "input = [0.1, 0.0]", "cost.input", "a weight is not positive"),
        ("position_m = [0.0, 0.0, 0.0]", "position_m = [60, 0, 0]", "target.position_m[0]", "outside the"),
        ("accel_mps2 = [3.71,", "accel_mps2 = [0,", "limits.accel_mps2", "a limit is not positive"),
    ],
)  # fmt: skip
def test_one_wrong_key_is_told_with_its_line(old: str, new: str, key: str, words: str) -> None:
    text = changed(old, new)
    found = problems(text)
    matching = [problem for problem in found if f": {key}: " in problem]
    assert matching, found
    place, _, rest = matching[0].partition(f": {key}: ")
    assert words in rest
    assert rest.rpartition("; ")[2], "no word of what to do"
    name = key.partition(".")[2].partition("[")[0]
    wanted = line_of(text, f"{name} =") if f"\n{name} =" in text else line_of(text, f"[{key.partition('.')[0]}]")
    assert place == f"my.toml:{wanted}"


@pytest.mark.fault(33)
def test_all_problems_come_at_once() -> None:
    text = changed("dt_s = 1.0", 'dt_s = "fast"').replace("[cost]", "[csot]").replace("loss = 0.3", "loss = 2")
    keys = {problem.split(": ")[1] for problem in problems(text, "limits.slew_mps3=-1", "nowhere=1")}
    assert keys == {"plant.dt_s", "csot", "cost", "link.loss", "limits.slew_mps3", "nowhere"}


def test_shapes_of_drag_lag_are_checked() -> None:
    with pytest.raises(ConfigError) as caught:
        load("room-hahn-stursberg", ["plant.lag_s=[0.2]", "plant.gain=[1, 1, 0]", "plant.drag_1ps=[-0.1, 0, 0]"])
    reasons = "\n".join(caught.value.problems)
    assert "plant.lag_s: has 1 entries, number of axes = 3" in reasons
    assert "plant.gain: [1.0, 1.0, 0.0] is out of range" in reasons
    assert "plant.drag_1ps: [-0.1, 0.0, 0.0] is out of range" in reasons


def test_what_an_override_broke_is_named_as_the_override() -> None:
    found = problems(PAPER, "link.loss=3", "smpc.tau=12", "oops", "name.x=1")
    assert any(problem.startswith("--set link.loss=3: link.loss: ") for problem in found)
    assert any(problem.startswith("--set smpc.tau=12: smpc.tau: ") for problem in found)
    assert any("--set oops: is not an override" in problem for problem in found)
    assert any("--set name.x=1: name is a value, not a table" in problem for problem in found)


@pytest.mark.parametrize(("text", "line"), [("a = 1\nb = = 2\n", 2), ("[plant\n", 1), ('a = """\n', 2)])
def test_toml_syntax_errors_have_their_line(text: str, line: int) -> None:
    (problem,) = problems(text)
    assert problem.startswith(f"my.toml:{line}: TOML syntax: ")


@pytest.mark.fault(33)
def test_a_missing_file_names_the_presets(tmp_path: Path) -> None:
    for name in (str(tmp_path / "nothing.toml"), "papr"):
        with pytest.raises(ConfigError, match=r"no such file or preset.*paper, room"):
            load(name)
    with pytest.raises(ConfigError, match='nearest valid name "paper"'):
        load("papr")
    with pytest.raises(ConfigError, match="cannot be read"):
        load(str(tmp_path))
    (tmp_path / "latin.toml").write_bytes(b"# \xff\n")
    with pytest.raises(ConfigError, match="UTF-8"):
        load(str(tmp_path / "latin.toml"))


def test_a_design_error_is_told_with_file_and_line() -> None:
    error = DesignError("smpc.k_tau", "spectral radius 1.2 is not below 1", "give a smaller gain")
    loaded = parse(PAPER, "my.toml")
    line = line_of(PAPER, "k_tau =")
    assert describe_design_error(loaded.source, error) == (
        f"my.toml:{line}: smpc.k_tau: spectral radius 1.2 is not below 1; give a smaller gain"
    )
    overridden = parse(PAPER, "my.toml", ["smpc.delta_x=0.999"]).source
    assert describe_design_error(overridden, DesignError("smpc.delta_x", "a", "b")).startswith(
        "--set smpc.delta_x=0.999: "
    )
    # A key with a default, which the file does not have, is told at its table.
    assert describe_design_error(loaded.source, DesignError("schedule.gamma_max", "a", "b")).startswith(
        f"my.toml:{line_of(PAPER, '[schedule]')}: "
    )


def test_index_finds_tables_dotted_keys_and_rows() -> None:
    text = '''# [no.table]
title = "a = 1 # no" # [x]
many = [
  [1, 2],  # ] }
  [3,
   4],
]
[one . two]
"quoted" = {a = 1, b = {c = [5]}}
dotted.key = 1979-05-27T07:32:00Z
text = """
[three]
four = 4
"""
[three]
four = \'\'\'it's\'\'\'
five = 'x'
'''
    lines = find_key_lines(text)
    del lines["one.two.quoted[1]"], lines["one.two.quoted[1][0]"]  # brackets within an inline table
    assert lines == {
        "title": 2,
        "many": 3, "many[0]": 4, "many[1]": 5,
        "one": 8, "one.two": 8,
        "one.two.quoted": 9,
        "one.two.dotted": 10, "one.two.dotted.key": 10,
        "one.two.text": 11,
        "three": 15, "three.four": 16, "three.five": 17,
    }  # fmt: skip


_LEAVES = st.one_of(st.integers(), st.booleans(), st.text(max_size=5), st.floats(allow_nan=False))
_VALUES = st.recursive(_LEAVES, lambda inner: st.lists(inner, max_size=3), max_leaves=6)


@given(st.dictionaries(st.sampled_from("abc"), st.dictionaries(st.sampled_from("xyz"), _VALUES, min_size=1)))
def test_index_agrees_with_a_document_written_line_by_line(document: dict[str, dict[str, object]]) -> None:
    written, wanted = [], {}
    for table, pairs in document.items():
        written.append(f"[{table}]")
        wanted[table] = len(written)
        for key, value in pairs.items():
            written.append(f"{key} = {toml(value)}")
            wanted[f"{table}.{key}"] = len(written)
    lines = find_key_lines("\n".join(written))
    assert {key: line for key, line in lines.items() if "[" not in key} == wanted


def toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(character):08x}" for character in value) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return str(value)


def test_the_reference_page_is_complete() -> None:
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    items = re.findall(r"^\* `\w+(?: = [^`]+)?`[^:]*: ", re.sub("\n  ", " ", page), re.MULTILINE)
    assert len(items) == len(re.findall(r"^\s+\w+: Annotated\[|^    name: ", config_source(), re.MULTILINE))


def config_source() -> str:
    files = sorted((ROOT / "uavctl" / "config").glob("*.py"))
    return "".join(file.read_text(encoding="utf-8") for file in files)


def test_a_configuration_cannot_be_changed() -> None:
    config: Config = load_config("paper")
    with pytest.raises(AttributeError):
        config.name = "other"  # type: ignore[misc]  # frozen: that is the point


def test_the_default_scheme_is_that_of_the_rooms_and_a_recording_without_the_key_has_the_one_of_before() -> None:
    text = dump_config(load_config("room-hahn-stursberg"))
    without = text.replace('scheme = "hahn-stursberg"\n', "")
    assert without != text
    assert parse_recorded(without, "flight").config == load_config("room-hahn-stursberg")
    with pytest.raises(ConfigError) as caught:  # what flew before must not silently fly otherwise
        parse(without, "mine.toml")
    assert "smpc.tau" in str(caught.value) and "smpc.scheme" in str(caught.value)
    (default,) = [field.default for field in msgspec.structs.fields(SmpcConfig) if field.name == "scheme"]
    assert default == load_config("room").smpc.scheme == "age-conditioned"
