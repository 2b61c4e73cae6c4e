"""A campaign's file: what it gives, and every way in which it can be wrong."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from campaign_rig import HEAD, controller, read, table
from places import ROOT

from uavctl.config import load_config
from uavctl.config.types import Config
from uavctl.errors import ConfigError
from uavctl.lab.campaign.spec import read_campaign

LINKS = table("link", "good", 'set = ["link.loss=0.1"]') + table("link", "bad", 'set = ["link.loss=0.6"]')


def problems(folder: Path, *parts: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        read(folder, *parts)
    return [problem.removeprefix(f"{folder}/small.toml:") for problem in refused.value.problems]


def by_key(texts: list[str]) -> dict[str, str]:
    """Return what is told of each key, of problems as "line: key: what"."""
    return {key: problem for _, key, problem in (text.split(": ", 2) for text in texts)}


def same(one: Config, other: Config) -> bool:
    return msgspec.json.encode(one) == msgspec.json.encode(other)


def test_a_short_file_has_all_defaults(tmp_path: Path) -> None:
    campaign = read(tmp_path, controller("lqg"))
    spec = campaign.spec
    assert (spec.runs, spec.steps, spec.master) == (1000, 50, 0)
    assert [len(sections) for sections in (spec.link, spec.disturbance, spec.plant)] == [1, 1, 1]
    assert same(campaign.base, load_config("paper")) and same(
        campaign.believed_configs[0, "as configured"], campaign.base
    )


def test_each_controller_has_its_own_belief(tmp_path: Path) -> None:
    campaign = read(
        tmp_path,
        'set = ["smpc.delta_u=0.8"]\n',
        controller("smpc", 'set = ["risk.allocation=halfspace"]'),
        controller("lqg", 'link = "bad"'),
        LINKS,
        table("plant", "strong", 'set = ["plant.w=[[1.2, 0.0], [0.0, 1.2]]"]'),
        '[[tuning]]\ncontrollers = ["smpc"]\nlinks = ["bad"]\nset = ["smpc.tau=3", "risk.allocation=ellipsoid"]\n',
    )
    believed = campaign.believed_configs
    assert set(believed) == {(0, "good"), (0, "bad"), (1, "bad")}
    assert {config.smpc.delta_u for config in believed.values()} == {0.8}
    good, bad, wrong = believed[0, "good"], believed[0, "bad"], believed[1, "bad"]
    assert (good.link.loss, good.risk.allocation, good.smpc.tau) == (0.1, "halfspace", 4)
    assert (bad.link.loss, bad.risk.allocation, bad.smpc.tau) == (0.6, "ellipsoid", 3)
    assert (wrong.link.loss, wrong.risk.allocation, wrong.smpc.tau) == (0.6, "ellipsoid", 4)
    # Only what is flown changes with the plant.
    assert [flown_plant.plant.w[0][0] for flown_plant in campaign.flown_plants] == [1.2]
    assert {config.plant.w[0][0] for config in believed.values()} == {0.6}
    assert [flown_link.link.loss for flown_link in campaign.flown_links] == [0.1, 0.6]
    assert [campaign.get_believed_link(i, j) for i in (0, 1) for j in (0, 1)] == ["good", "bad", "bad", "bad"]


def test_a_configuration_file_is_found_beside_the_campaign(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text((ROOT / "uavctl/presets/paper.toml").read_text())
    file = tmp_path / "campaign.toml"
    file.write_text('name = "mine"\nconfig = "mine.toml"\n' + controller("lqg"))
    assert same(read_campaign(file)[0].base, load_config("paper"))


def test_another_number_of_runs(tmp_path: Path) -> None:
    read(tmp_path, controller("lqg"))
    assert read_campaign(tmp_path / "small.toml", 7)[0].spec.runs == 7


def test_wrong_keys_and_values_are_reported_together_with_line_and_nearest_name(tmp_path: Path) -> None:
    texts = problems(
        tmp_path, "stps = 20\nruns = 0\n", table("controller", "a", 'kind = "lgq"'), table("disturbance", "b")
    )
    assert [text.split(":")[0] for text in texts] == ["3", "4", "7"]
    problem = by_key(texts)
    assert '"steps"' in problem["stps"] and ">= 1" in problem["runs"]
    assert '"lgq"' in problem["controller[0].kind"] and '"lqg"' in problem["controller[0].kind"]


def test_a_quadrotor_which_campaigns_do_not_fly_is_refused_where_it_stands(tmp_path: Path) -> None:
    quadrotor = '"sim.start_position_m=[0, 0, -1.5]", "sim.plant=quadrotor"'
    reason = 'sim.plant is "quadrotor"'
    (texts,) = problems(tmp_path, f"set = [{quadrotor}]\n", controller("lqg"))
    assert texts.startswith(f"3: set[1]: {reason}") and 'sim.plant = "linear"' in texts
    (texts,) = problems(tmp_path, controller("lqg", f"set = [{quadrotor}]"))
    assert texts.startswith(f"6: controller[0].set[1]: {reason}") and 'sim.plant = "linear"' in texts
    text = (ROOT / "uavctl/presets/room-hahn-stursberg.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(text.replace("[sim]", '[sim]\nplant = "quadrotor"'), encoding="utf-8")
    file = tmp_path / "campaign.toml"
    file.write_text('name = "mine"\nconfig = "mine.toml"\n' + controller("lqg"), encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        read_campaign(file)
    assert refused.value.problems[0].startswith(f"{file}:2: config: {reason}")


def test_wrong_overrides_are_reported_with_their_lines(tmp_path: Path) -> None:
    texts = problems(
        tmp_path,
        controller("smpc", 'set = ["smpc.tua=3"]'),
        table("link", "good", 'set = ["link.los=0.1", "plant.dt_s=2"]'),
        table("plant", "other", 'set = ["plant.a=[[1.0]]"]'),
    )
    assert len(texts) >= 4
    expected = (
        ("6: controller[0].set[0]: smpc.tua=3: smpc.tua: ", '"tau"'),
        ("9: link[0].set[0]: link.los=0.1: link.los: ", '"loss"'),
        ("9: link[0].set[1]: plant.dt_s=2: ", "link.*"),
        ("12: plant[0].set: plant.b: ", "4 x 2"),
    )
    for place, problem in expected:
        assert [text for text in texts if text.startswith(place) and problem in text], (place, texts)


def test_names_have_to_be_known_and_different(tmp_path: Path) -> None:
    texts = problems(
        tmp_path,
        controller("lqg", 'link = "goood"'),
        controller("lqg"),
        LINKS,
        table("link", "true"),
        table("disturbance", "calm", "memory = 0.5"),
        '[[tuning]]\ncontrollers = ["lgq"]\nlinks = ["bed"]\nset = ["smpc.tau=3"]\n',
    )
    problem = by_key(texts)
    for key, named in (
        ("controller[1].name", ("lqg",)),
        ("controller[0].link", ("goood", "good")),
        ("link[2].name", ("true",)),
        ("disturbance[0].memory", ("gaussian",)),
        ("tuning[0].controllers[0]", ("lgq", "lqg")),
        ("tuning[0].links[0]", ("bed", "bad")),
    ):
        assert all(f'"{name}"' in problem[key] for name in named), (key, texts)


@pytest.mark.parametrize(
    ("line", "key", "texts"),
    [
        ("start = [1.0]", "start", "n_x = 4"),
        ("start_box = [[0.0, 0.0, 0.0, 0.0]]", "start_box", "2 rows of n_x = 4"),
        ("start_box = [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]]", "start_box", "lower limit"),
        ("start = [0, 0, 0, 0]\nstart_box = [[0, 0, 0, 0], [1, 1, 1, 1]]", "start_box", "a start too"),
        ("controller = []", "controller", "empty"),
        ('set = ["link.loss=2"]', "set[0]", "link.loss=2: link.loss"),
    ],
)
def test_starts_and_lists_have_to_fit(tmp_path: Path, line: str, key: str, texts: str) -> None:
    parts = [f"{line}\n"] if line.startswith("controller") else [f"{line}\n", controller("lqg")]
    assert texts in by_key(problems(tmp_path, *parts))[key]


def test_a_plant_of_another_size_is_refused(tmp_path: Path) -> None:
    step = table("plant", "slow", 'set = ["plant.dt_s=2.0"]')
    texts = problems(tmp_path, controller("lqg"), step)
    problem = by_key(texts)["plant[0].set"]
    assert "(4, 2)" in problem and "Δt = 2 s" in problem


def test_a_missing_or_unreadable_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        read_campaign(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text(HEAD + "runs = \n")
    with pytest.raises(ConfigError, match=r"bad\.toml:3: TOML syntax"):
        read_campaign(tmp_path / "bad.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff")
    with pytest.raises(ConfigError, match="UTF-8"):
        read_campaign(tmp_path / "bytes.toml")
    (tmp_path / "unknown.toml").write_text('name = "a"\nconfig = "papr"\n' + controller("lqg"))
    with pytest.raises(ConfigError, match="no such file or preset"):
        read_campaign(tmp_path / "unknown.toml")
