"""What viewers get, against the records that it is made from."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep
from view_rig import fly_view

from logs.recording.derived_topics import VIEWS
from logs.recording.design_view import DesignView, read_design
from logs.recording.views import PLAN_NS, STD_95, STILL_NS, ViewBuilder, draw_plan, draw_room
from uavctl.errors import RecordingError
from uavctl.frames import Frame, rotate_vector
from uavctl.records import (
    ControlMode,
    Decision,
    Estimate,
    Event,
    Header,
    Plan,
    Record,
    Severity,
    SolveStatus,
    StepInput,
    Truth,
    Vec3,
)

KINDS = {view.name: view.message for view in VIEWS}
Found = dict[str, list[tuple[int, Any]]]


def views(*records: Record, maker: ViewBuilder | None = None) -> Found:
    """Messages by topic, of these records or of the whole flight."""
    maker = maker or ViewBuilder()
    found: Found = {name: [] for name in KINDS}
    entries = [(getattr(one, "at_ns", 0), one) for one in records] or [(at, one) for _, at, one in fly_view().entries]
    for at_ns, record in entries:
        for topic, data in maker.derive(at_ns, record):
            found[topic].append((at_ns, KINDS[topic].FromString(data)))
    return found


@pytest.fixture(scope="module")
def found() -> Found:
    return views()


@pytest.fixture(scope="module")
def design() -> DesignView:
    return read_design(fly_view().of(Header)[0])


def place(vector: Any) -> Vec3:
    return vector.x, vector.y, vector.z


def seconds(stamp: Any) -> int:
    return int(stamp.seconds * 10**9 + stamp.nanos)


def test_each_topic_has_as_many_messages_as_its_records(found: Found) -> None:
    memory = fly_view()
    ticks, plans = memory.of(Decision), [p for p in memory.of(Plan) if p.status is SolveStatus.OPTIMAL]
    boundaries = [one for one in ticks if one.boundary]
    counts = {topic: len(messages) for topic, messages in found.items()}
    estimates, truths = len(memory.of(Estimate)), len(memory.of(Truth))
    assert counts["/view/estimate"] == counts["/view/vehicle_frame"] == counts["/plot/state"] == estimates > 100
    assert counts["/view/truth"] == counts["/plot/truth"] == truths > 20
    assert counts["/view/measured"] == sum(len(one.samples) for one in memory.of(StepInput)) > 10
    assert counts["/view/plan"] == counts["/view/scene/plan"] == counts["/plot/limits"] == len(plans) > 10
    assert counts["/plot/age"] == counts["/plot/input"] == len(ticks)
    assert counts["/view/scene/link"] == len(boundaries) >= counts["/view/target"] > 20
    assert counts["/view/log"] == len(memory.of(Event))
    assert all(counts.values())


def test_plans_that_come_quickly_are_not_all_drawn() -> None:
    header, plan = fly_view().of(Header)[0], next(p for p in fly_view().of(Plan) if p.status is SolveStatus.OPTIMAL)
    maker = ViewBuilder()
    maker.derive(0, header)
    times_ns = [n * 50_000_000 for n in range(40)]
    drawn_ns = [at for at in times_ns if any(topic == "/view/scene/plan" for topic, _ in maker.derive(at, plan))]
    assert min(later - one for one, later in pairwise(drawn_ns)) == PLAN_NS
    assert len(drawn_ns) == 10


def test_positions_are_those_of_the_records(found: Found, design: DesignView) -> None:
    for (_, message), estimate in zip(found["/view/estimate"], fly_view().of(Estimate), strict=True):
        assert place(message.pose.position) == design.position_of(estimate.mean)
        assert (message.frame_id, seconds(message.timestamp)) == ("ned", estimate.at_ns)
    samples = [sample for one in fly_view().of(StepInput) for sample in one.samples]
    for (_, message), sample in zip(found["/view/measured"], samples, strict=True):
        assert (place(message.pose.position), seconds(message.timestamp)) == (sample.position_m, sample.captured_ns)
    (_, plan), one = found["/view/plan"][0], next(p for p in fly_view().of(Plan) if p.status is SolveStatus.OPTIMAL)
    assert [place(pose.position) for pose in plan.poses] == [design.position_of(state) for state in one.states]


def test_the_room_is_turned_as_frames_say(found: Found) -> None:
    ((transform,),) = [message.transforms for _, message in found["/view/frames"][:1]]
    turn = transform.rotation
    for ned_m in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.5, -2.0, -0.7)):
        turned = rotate_vector((turn.w, turn.x, turn.y, turn.z), ned_m)
        assert turned == pytest.approx(Frame("enu").from_ned(ned_m), abs=1e-12)
    assert (transform.parent_frame_id, transform.child_frame_id) == ("room", "ned")


def test_the_frames_form_one_tree(found: Found) -> None:
    _, moving = found["/view/vehicle_frame"][-1]
    assert (moving.parent_frame_id, moving.child_frame_id) == ("ned", "vehicle")
    scenes = [m for t in found for _, m in found[t] if t.startswith("/view/scene")]
    assert {entity.frame_id for scene in scenes for entity in scene.entities} == {"ned", "vehicle"}


def test_what_does_not_move_is_told_every_five_seconds(found: Found) -> None:
    for topic in ("/view/frames", "/view/scene/room"):
        times = [at_ns for at_ns, _ in found[topic]]
        assert times[0] == 0 and len(times) == 2
        assert all(later - earlier >= STILL_NS for earlier, later in pairwise(times))


def test_the_room_is_the_box_of_the_limits(design: DesignView) -> None:
    (entity,) = draw_room(0, design).entities
    (line,) = entity.lines
    corners = np.array([place(point) for point in line.points])
    assert corners.min(axis=0).tolist() == [-3.0, -2.5, -2.5]
    assert corners.max(axis=0).tolist() == [3.0, 2.5, 0.0]
    edges = np.array(line.indices).reshape(-1, 2)
    assert len(edges) == 12
    assert {int(np.count_nonzero(corners[a] != corners[b])) for a, b in edges} == {1}


def test_an_open_side_is_drawn_near_the_target(design: DesignView) -> None:
    number = design.position_index[0]
    row = int(design.state_box.row_upper[number])
    open_side = msgspec.structs.replace(design, b_x=(*design.b_x[:row], math.inf, *design.b_x[row + 1 :]))
    (entity,) = draw_room(0, open_side).entities
    assert max(point.x for point in entity.lines[0].points) == design.target_m[0] + 5.0


def test_a_plan_s_ellipsoids_are_its_back_offs(design: DesignView) -> None:
    plan = next(p for p in fly_view().of(Plan) if p.status is SolveStatus.OPTIMAL)
    scene = {entity.id: entity for entity in draw_plan(0, design, plan, None).entities}
    box = design.state_box
    for sphere, state, backoff in zip(scene["predicted spread"].spheres, plan.states, plan.backoff_x, strict=True):
        assert place(sphere.pose.position) == design.position_of(state)
        want = [2 * max(backoff[box.row_lower[i]], backoff[box.row_upper[i]]) for i in design.position_index]
        assert place(sphere.size) == pytest.approx(want)
    tight = np.array([place(point) for point in scene["limits less back-offs"].lines[0].points])
    last = [plan.backoff_x[-1][box.row_upper[i]] for i in design.position_index]
    assert tight.max(axis=0) == pytest.approx(np.array([3.0, 2.5, 0.0]) - last)


def test_the_estimate_s_ellipsoid_holds_95_percent(design: DesignView) -> None:
    plan = next(p for p in fly_view().of(Plan) if p.status is SolveStatus.OPTIMAL)
    rng = np.random.default_rng(4)
    root = rng.normal(size=(9, 9))
    cov = root @ root.T
    estimate = msgspec.structs.replace(fly_view().of(Estimate)[0], cov=tuple(map(tuple, cov.tolist())))
    scene = {entity.id: entity for entity in draw_plan(0, design, plan, estimate).entities}
    (sphere,) = scene["estimate, 95 %"].spheres
    turn = sphere.pose.orientation
    drawn = rng.multivariate_normal(np.array(estimate.mean), cov, size=4000)
    inside = 0
    for state in drawn:
        offset = np.array(design.position_of(state)) - place(sphere.pose.position)
        own = rotate_vector((turn.w, -turn.x, -turn.y, -turn.z), (offset[0], offset[1], offset[2]))
        assert own is not None
        inside += sum((2 * x / size) ** 2 for x, size in zip(own, place(sphere.size), strict=True)) <= 1.0
    # 95 % of 4000, give or take four standard deviations
    assert abs(inside / 4000 - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 4000)
    assert pytest.approx(7.8147, abs=1e-3) == STD_95**2  # chi squared, three degrees of freedom


def test_plots_have_the_numbers_of_the_records(found: Found, design: DesignView) -> None:
    for (_, age), decision in zip(found["/plot/age"], fly_view().of(Decision), strict=True):
        want = math.nan if decision.age_steps is None else decision.age_steps
        assert age.age_steps == pytest.approx(want, nan_ok=True)
        assert (age.mode, age.limit_steps, age.news) == (decision.mode.value, design.horizon, decision.news)
    rows = dict(zip(design.c_u, design.b_u, strict=True))
    lower_down = -next(limit for row, limit in rows.items() if row[2] < 0)
    upper_north = next(limit for row, limit in rows.items() if row[0] > 0)
    for (_, plot), decision in zip(found["/plot/input"], fly_view().of(Decision), strict=True):
        want_u = decision.input or (math.nan,) * 3
        assert (plot.chosen.north, plot.chosen.east, plot.chosen.down) == pytest.approx(want_u, nan_ok=True)
        assert (plot.lower.down, plot.upper.north) == pytest.approx((lower_down, upper_north))
        assert (plot.lower.down, plot.upper.north) == pytest.approx((-1.5, 2.0))  # of the preset: what may be flown
    for (_, plot), estimate in zip(found["/plot/state"], fly_view().of(Estimate), strict=True):
        assert plot.position_std_m.east == pytest.approx(math.sqrt(estimate.cov[3][3]))
    _, timing = found["/plot/timing"][0]
    assert (timing.lateness_us, timing.step_us, timing.send_us) == (1.5, 250.0, 400.0)
    assert math.isnan(timing.capture_to_send_ms)
    aged = {estimate.at_ns: estimate.age_s for estimate in fly_view().of(Estimate)}
    shown = {at_ns: age.age_s for at_ns, age in found["/plot/age"] if at_ns in aged}
    assert shown == pytest.approx(aged)


def test_the_link_is_green_with_news_amber_in_silence_red_in_the_fallback(design: DesignView) -> None:
    header, decision = fly_view().of(Header)[0], next(d for d in fly_view().of(Decision) if d.boundary)
    cases = {
        "news": msgspec.structs.replace(decision, mode=ControlMode.TRACK, news=True, age_steps=1),
        "silence": msgspec.structs.replace(decision, mode=ControlMode.TRACK, news=False, age_steps=4),
        "fallback": msgspec.structs.replace(decision, mode=ControlMode.BRAKE, news=False, age_steps=12),
    }
    scenes = {name: views(header, one)["/view/scene/link"][0][1] for name, one in cases.items()}
    colours = {name: scene.entities[0].spheres[0].color for name, scene in scenes.items()}
    assert colours["news"].g > 0.8 > colours["news"].r
    assert colours["silence"].r == 1.0 and 0.5 < colours["silence"].g < 0.8
    assert colours["fallback"].r > 0.9 and colours["fallback"].g < 0.3
    assert scenes["fallback"].entities[0].texts[0].text == f"brake, age 12 of {design.horizon} steps"


def test_events_keep_their_severity_and_count() -> None:
    header = fly_view().of(Header)[0]
    events = [Event(at_ns=n, severity=one, code="c", text="t", count=1 + n) for n, one in enumerate(Severity)]
    lines = [message for _, message in views(header, *events)["/view/log"]]
    assert [line.Level.Name(line.level) for line in lines] == ["INFO", "WARNING", "ERROR"]
    assert [(line.name, line.message) for line in lines] == [("c", "t"), ("c", "t (2 times)"), ("c", "t (3 times)")]


def test_paths_are_those_of_the_last_twenty_seconds() -> None:
    maker = ViewBuilder()
    header, truth, decision = fly_view().of(Header)[0], fly_view().of(Truth)[0], fly_view().of(Decision)[0]
    maker.derive(0, header)
    for tenth in range(500):
        at_ns = tenth * 100_000_000
        maker.derive(at_ns, msgspec.structs.replace(truth, at_ns=at_ns, position_m=(float(tenth), 0.0, 0.0)))
    late = msgspec.structs.replace(decision, at_ns=50_000_000_000)
    ((_, scene),) = views(late, maker=maker)["/view/scene/path"]
    (line,) = {entity.id: entity for entity in scene.entities}["flown path"].lines
    assert [point.x for point in line.points] == [float(tenth) for tenth in range(300, 500, 2)]


def test_a_plan_that_failed_is_in_the_plot_only() -> None:
    header, plan = fly_view().of(Header)[0], fly_view().of(Plan)[0]
    failed = msgspec.structs.replace(plan, status=SolveStatus.FAILED, states=(), inputs=(), backoff_x=())
    made = {topic: messages for topic, messages in views(header, failed).items() if messages}
    assert made.keys() == {"/view/frames", "/view/scene/room", "/plot/solve"}
    assert made["/plot/solve"][0][1].status == "failed"


def test_nothing_is_made_before_a_header() -> None:
    assert not any(views(*fly_view().of(Estimate)[:3], *fly_view().of(Event)).values())


def test_a_design_that_cannot_be_used_is_told() -> None:
    header = msgspec.structs.replace(fly_view().of(Header)[0], design={"gamma_x": [1.0]})
    maker = ViewBuilder()
    with pytest.raises(RecordingError, match="design cannot be used"):
        maker.derive(0, header)
    assert maker.derive(1, fly_view().of(Estimate)[0]) == []


def test_a_plant_in_the_plane_has_no_number_for_the_third_axis() -> None:
    maker, made = ViewBuilder(), set()
    for _, at_ns, record in lockstep("paper", 4.0).entries:
        for topic, data in maker.derive(at_ns, record):
            made.add(topic)
            if topic == "/plot/state":
                state: Any = KINDS[topic].FromString(data)
                assert math.isfinite(state.position_m.east) and math.isnan(state.position_m.down)
    assert made == KINDS.keys() - {"/plot/timing"}
