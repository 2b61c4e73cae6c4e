"""Headline of a flight: what matters most in one line, and sentences on why, drawn from the recording only."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.flight import FLOWN, FlightData
from logs.recording.summary import BLIND_S, FlightSummary, box_at, count, input_outside, position_error_m, state_outside
from logs.report.excursion import GRAVE_M, Clearance, Excursion, excursions, trusted
from logs.report.verdicts import Judged, flown_config
from uavctl.build.controller import build_estimator
from uavctl.config import Config
from uavctl.flight.envelope import OF_POSITIONS
from uavctl.mavlink.connection import HUNG_UP, WENT_SILENT
from uavctl.outcome import Cause
from uavctl.records import ControlMode, Decision, number

GOOD, MIND, BAD = "good", "mind", "bad"  # of a headline: its colour

_ITS_LINK = "link vehicle: "  # begins what is told of the vehicle's connection
_UNHEARD_S = 2.5  # a heartbeat comes each second
_PUSH_MPS2, _PUSH_MPS = 0.1, 0.3  # carries a vehicle off by as much as is worth telling, if it lasts
_LOOKED_AT_S, _AFTER_S = 0.3, 3.0  # least time to tell a push in, and the longest until a limit is left for it
_WRONG_M = 0.3  # between a position that was used and the true place: no noise of a camera
_GATE_SHARE = 0.15  # of the setpoints: setting out takes some
_FEW = 0.05  # of positions, or plans
_AT_BOUND = 0.999  # of the largest bias
_NEAR_BOUND = 0.7  # of the acceleration that the envelope allows to be unexplained
_ARRIVED_M, _ARRIVED_SHARE = 0.3, 0.1  # distance from the target at the end, of that at the beginning
_BEGUN_S = 1.0  # it is still about where it began
_COMPASS = {"north": ("north", "south"), "east": ("east", "west"), "down": ("down", "up")}


@dataclass(frozen=True)
class Headline:
    """One line on what matters most in a flight, in colour and words, and the sentences below it."""

    tone: str  # GOOD, MIND or BAD
    word: str  # what it comes to, in two or three words
    text: str  # the rest of the line
    why: tuple[str, ...]
    at_s: float = 0.0  # moment to look at first


def headline(flight: FlightData, summary: FlightSummary, judged: Judged) -> Headline:
    """Return what matters most in a flight; `summary` and `judged` are its figures and verdicts."""
    told = _Told(flight, summary, judged)
    return told.headline()


def metres(value: float) -> str:
    """Return a length for a person: "1.6 m", "0.12 m", "4 mm"."""
    if value >= 0.995:
        return f"{value:.1f} m"
    return f"{value:.2f} m" if value >= 0.0095 else f"{1e3 * value:.0f} mm" if value >= 5e-4 else "less than 1 mm"


def seconds(value: float) -> str:
    """Return a time or a length of time for a person, to a tenth of a second: "19.8 s"."""
    return f"{value:.1f} s"


class Push(NamedTuple):
    """Acceleration outwards that no setpoint asked for, over a time [s]."""

    begun_s: float
    ended_s: float
    accel_mps2: float


class _Told:
    """What is told of a flight, made from its records."""

    def __init__(self, flight: FlightData, summary: FlightSummary, judged: Judged) -> None:
        self.flight, self.summary, self.judged = flight, summary, judged
        self.config: Config | None = flown_config(flight)
        self.clearance = Clearance.of(flight)
        self.excursions = excursions(flight)
        self.estimate_s = flight.seconds([one.at_ns for one in flight.estimates])
        self.wrong_s, self.wrong_m = _wrong(flight)
        self.taken_s = flight.seconds([one.at_ns for one in flight.decisions if one.accepted])
        self.breach_s = np.inf if flight.breach is None else float(flight.seconds([flight.breach.at_ns])[0])

    def headline(self) -> Headline:
        s = self.summary
        if s.final_error_m is None or s.settled_error_m is None:
            last = (self.flight.flown or self.flight.decisions)[-1]
            return Headline(MIND if s.ending.as_ordered else BAD, "Nothing was flown", f"{last.reason}.", ())
        if self.excursions and (self.excursions[0].beyond_m >= GRAVE_M or s.ending.as_ordered):
            worst = self.excursions[0]
            tone, word = (BAD, "Left its limits") if worst.beyond_m >= GRAVE_M else (MIND, "Touched a limit")
            text = (
                f"went {metres(worst.beyond_m)} {worst.passage} at {seconds(worst.worst_s)}{self._how(worst)}"
                f"{self._seen(worst.worst_s)}."
            )
            return Headline(tone, word, text, tuple(self._why(worst)), worst.worst_s)
        if not s.ending.as_ordered:
            at_s = self._ended_s()
            when = "" if at_s is None else f" at {seconds(at_s)}"
            last = (self.flight.flown or self.flight.decisions)[-1]
            ended = s.ending.cause if s.ending.cause != Cause.WAITING else f"at the end it was waiting ({last.reason})"
            text = f"{ended}{when}{self._blind_text(at_s)}; {self._stayed()}."
            return Headline(BAD, "Not as ordered", text, tuple(self._why(None)), at_s or 0.0)
        return self._inside(s.settled_error_m, s.final_error_m)

    def _inside(self, settled_m: float, final_m: float) -> Headline:
        """Return the headline of a flight that ended as ordered and kept within the limits of its position."""
        s, flight = self.summary, self.flight
        why = tuple(self._why(None))
        stayed = self._stayed()
        if s.state_violations:
            text, at_s = self._limit()
            return Headline(MIND, "Beyond a limit", f"{text}; {stayed}.", why, at_s)
        if s.fallbacks:
            spans, first = flight.fallback_spans, flight.fallen[0]
            total_s = sum(end - begin for begin, end in spans)
            when = f"for {seconds(total_s)} in all, from {seconds(spans[0][0])} on"
            text = f"the fallback flew {when}: {first.reason}; {stayed}."
            return Headline(MIND, "Fell back", text, why, spans[0][0])
        if s.input_violations:
            at_s = float(flight.steps.t_s[input_outside(flight)][0])
            text = f"an input was beyond its limits at {count(s.input_violations, 'step')}, first at {seconds(at_s)}"
            return Headline(MIND, "Beyond a limit", f"{text}; {stayed}.", why, at_s)
        goal = "trajectory" if s.trajectory else "target"
        if not s.trajectory and final_m > max(_ARRIVED_M, _ARRIVED_SHARE * float(position_error_m(flight)[0])):
            text = f"{metres(final_m)} from its target at the last step{self._out_of_reach()}; {stayed}."
            return Headline(MIND, "Not there yet", text, why, float(flight.steps.t_s[-1]))
        text = f"{stayed}; {metres(settled_m)} from its {goal} over the last quarter (root mean square)."
        return Headline(GOOD, "All well", text, why)

    def _stayed(self) -> str:
        """Return that it stayed inside the limits of its position, with how near it came to one of them."""
        if self.excursions:
            worst = self.excursions[0]
            return f"{metres(worst.beyond_m)} {worst.passage} at {seconds(worst.worst_s)}{self._seen(worst.worst_s)}"
        nearest = self.clearance.nearest()
        if nearest is None:
            return "its position has no limits"
        wall, free_m, at_s = nearest
        begun = at_s < float(self.clearance.t_s[0]) + _BEGUN_S
        near = (
            f"{metres(free_m)} from the {wall} at the nearest, {'where it began' if begun else f'at {seconds(at_s)}'}"
        )
        return f"inside its walls throughout, {near}{self._seen(at_s)}"

    def _out_of_reach(self) -> str:
        """Return by how much the target lay beyond a limit of position at the end; empty if it did not."""
        flight, design = self.flight, self.flight.design
        index = list(design.position_index)
        target = flight.steps.target[-1, index]
        lower, upper = (side[0, index] for side in box_at(flight, flight.steps.t_s[-1:]))
        beyond = np.maximum(lower - target, target - upper)
        most = int(beyond.argmax())
        if beyond[most] <= 0.0:
            return ""
        return f", which lay {metres(float(beyond[most]))} beyond the limit {design.axes[most]} by then"

    def _seen(self, at_s: float) -> str:
        """Return by what it is known where the vehicle was at a time; empty where that is the truth."""
        if self.flight.truths:
            return ""
        breach = self.flight.breach
        doubted = breach is not None and breach.code in OF_POSITIONS and at_s >= self.breach_s
        source = "positions that were no longer believed" if doubted else "the estimate"
        return f" (by {source}: the true state is unknown)"

    def _limit(self) -> tuple[str, float]:
        """Return the furthest excess of a state over a limit that is not one of position, and when it was [s]."""
        flight, design = self.flight, self.flight.design
        outside = state_outside(flight)
        states, t_s = flight.steps.state[outside], flight.steps.t_s[outside]
        lower, upper = box_at(flight, t_s)
        beyond = np.nan_to_num(np.maximum(lower - states, states - upper), nan=0.0, neginf=0.0, posinf=0.0)
        row, index = (int(one) for one in np.unravel_index(int(beyond.argmax()), beyond.shape))
        share = f"{len(t_s)} of {count(len(flight.steps), 'step')} outside"
        if beyond[row, index] <= 0.0:
            return share, float(t_s[0])
        unit = " m/s" if index in design.velocity_index else " m" if index in design.position_index else ""
        at_s = float(t_s[row])
        what = f"{beyond[row, index]:.2g}{unit} beyond the limit of {design.state_name(index)} at {seconds(at_s)}"
        return f"{what} ({share})", at_s

    def _ended_s(self) -> float | None:
        """Return when it was let go, or when the fallback had it land or stopped [s]; None if neither was."""
        flight = self.flight
        ends = (d.at_ns for d in flight.flown if d.mode in (ControlMode.LAND, ControlMode.STOPPED))
        at_ns = flight.breach.at_ns if flight.breach is not None else next(ends, None)
        return None if at_ns is None else float(flight.seconds([at_ns])[0])

    # --- what came to an excursion ---

    def _how(self, one: Excursion) -> str:
        """Return under which circumstances a limit was left, each by its own record."""
        told = self._blind_text(one.worst_s)
        wrong_m = self._wrong_before(one)
        if not told and wrong_m > _WRONG_M:
            told = f", flown on positions that were {metres(wrong_m)} off"
        if self._push(one) is not None:
            told += " while wind carried it" if told else ", carried by wind"
        mode = self._decision(one.worst_s).mode
        if mode in (ControlMode.LAND, ControlMode.STOPPED):
            told += ", after it was let go" if self.flight.breach is not None else ", in the vehicle's own landing"
        return told

    def _blind_text(self, at_s: float | None) -> str:
        age_s = 0.0 if at_s is None else self._age_s(at_s)
        return f", blind for {seconds(age_s)}" if age_s > self._blind_from_s() else ""

    def _blind_from_s(self) -> float:
        """Return the age of a position from which the vehicle counts as flown blind [s]."""
        return max(BLIND_S, 0.5 * self.flight.design.horizon * self.flight.design.dt_s)

    def _decision(self, at_s: float) -> Decision:
        decisions, at_ns = self.flight.decisions, self.flight.origin_ns + round(at_s * 1e9)
        return decisions[max(0, bisect_right(decisions, at_ns, key=lambda one: one.at_ns) - 1)]

    def _age_s(self, at_s: float) -> float:
        """Return how long ago the newest position was captured [s]; 0 before the first.

        The estimate tells, up to a breach of the envelope: then it takes back positions that did come.
        """
        place = int(np.searchsorted(self.estimate_s, at_s + 1e-6, side="right")) - 1
        if place < 0:
            return 0.0
        if at_s >= self.breach_s - 1e-6:
            taken_s = self.taken_s[self.taken_s <= at_s]
            return at_s - float(taken_s[-1]) if len(taken_s) else 0.0
        return self.flight.estimates[place].age_s + at_s - float(self.estimate_s[place])

    def _wrong_before(self, one: Excursion) -> float:
        """Return how far positions were off at most, up to the worst moment [m]."""
        before = self.wrong_m[self.wrong_s <= one.worst_s]
        return float(before.max(initial=0.0))

    def _push(self, one: Excursion) -> Push | None:
        """Return what pushed it outwards beside the setpoints, by the true velocity and the setpoints that were sent.

        Looked at from the last position on, or over the last second at least, while setpoints flew it. None where the
        truth is unknown, too little was flown, or nothing worth telling pushed.
        """
        flight = self.flight
        spans = [(begin, end) for begin, end in flight.spans(FLOWN) if begin < one.worst_s]
        if not flight.truths or not flight.setpoints or not spans:
            return None
        ended_s = min(one.worst_s, spans[-1][1])
        begun_s = max(spans[-1][0], min(ended_s - 1.0, one.worst_s - self._age_s(one.worst_s)))
        lasted_s = ended_s - begun_s
        if lasted_s < _LOOKED_AT_S or one.left_s - ended_s > _AFTER_S:
            return None
        number_of, column = AXIS_NUMBER[one.axis], flight.design.axes.index(one.axis)
        true_s = flight.seconds([truth.at_ns for truth in flight.truths])
        speeds = np.array([truth.velocity_mps[number_of] for truth in flight.truths])
        gained_mps = float(np.interp(ended_s, true_s, speeds) - np.interp(begun_s, true_s, speeds))
        lag_s = 0.0
        if self.config is not None and len(self.config.plant.lag_s) > column:
            lag_s = self.config.plant.dead_time_s + self.config.plant.lag_s[column]
        sent_s = flight.seconds([each.at_ns for each in flight.setpoints]) + lag_s
        sent = np.array([each.accel_mps2[number_of] for each in flight.setpoints])
        at = np.searchsorted(sent_s, np.linspace(begun_s, ended_s, 400, endpoint=False), side="right") - 1
        asked = float(np.where(at >= 0, sent[at], 0.0).mean())
        accel = one.outwards * (gained_mps / lasted_s - asked)
        worth_it = accel >= _PUSH_MPS2 and accel * lasted_s >= _PUSH_MPS
        return Push(begun_s, ended_s, accel) if worth_it else None

    # --- why ---

    def _why(self, worst: Excursion | None) -> Iterator[str]:
        """Return sentences on what lies behind the headline; where nothing does, one with the figures that show it."""
        told = [
            *(self._outside(worst) if worst is not None else ()),
            *self._unheard(),
            *self._let_go(),
            *self._blind(),
            *self._off(),
            *self._gate(),
            *self._bias(),
            *self._model(),
            *self._solver(),
            *self._late(),
        ]
        yield from told or (self._quiet(),)

    def _outside(self, worst: Excursion) -> Iterator[str]:
        until = "to the end of the recording" if worst.back_s is None else f"until {seconds(worst.back_s)}"
        whole = f"It was beyond the {worst.wall} from {seconds(worst.left_s)} on, {until}"
        others = [
            f"{metres(one.beyond_m)} {one.passage} at {seconds(one.worst_s)}"
            for one in self.excursions[1:3]
            if one.beyond_m >= min(GRAVE_M, worst.beyond_m)
        ]
        yield f"{whole}{'; also ' + ', '.join(others) if others else ''}."
        push = self._push(worst)
        if push is not None:
            yield (
                f"From {seconds(push.begun_s)} to {seconds(push.ended_s)} it was pushed outwards by "
                f"{push.accel_mps2:.1f} m/s² beside its setpoints: wind, or what acts like it."
            )
        believed = self._believed(worst)
        if believed is not None:
            yield believed

    def _believed(self, worst: Excursion) -> str | None:
        """Return a sentence on where the estimate put it at the worst moment; None if about right, or not known."""
        flight, at_ns = self.flight, self.flight.origin_ns + round(worst.worst_s * 1e9)
        near = min(trusted(flight), key=lambda one: abs(one.at_ns - at_ns), default=None)
        if not flight.truths or near is None or abs(near.at_ns - at_ns) > flight.tick_ns:
            return None
        believed_m = flight.design.position_of(near.mean)
        off_m = float(np.linalg.norm(np.subtract(believed_m, worst.worst_m)))
        if not np.isfinite(off_m) or off_m < _WRONG_M:
            return None
        return f"At {seconds(worst.worst_s)} the estimate put it {metres(off_m)} away from where it was."

    def _unheard(self) -> Iterator[str]:
        """Return a sentence on the longest time without a heartbeat of the vehicle, and how its connection was lost."""
        flight = self.flight
        heard_s = flight.seconds([*(one.at_ns for one in flight.vehicles), flight.decisions[-1].at_ns])
        gaps_s = np.diff(heard_s)
        if not gaps_s.size or gaps_s.max() <= _UNHEARD_S:
            return
        begun_s, ended_s = heard_s[gaps_s.argmax() :][:2]
        text = f"No heartbeat of the vehicle came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        lost = [one for one in flight.events if one.code in (HUNG_UP, WENT_SILENT) and one.text.startswith(_ITS_LINK)]
        if lost:
            (at_s,) = flight.seconds([lost[0].at_ns])
            text += f"; at {seconds(at_s)} {lost[0].text.removeprefix(_ITS_LINK).partition(';')[0]}"
        yield f"{text}."

    def _let_go(self) -> Iterator[str]:
        flight, s = self.flight, self.summary
        if flight.breach is not None:
            (at_s,) = flight.seconds([flight.breach.at_ns])
            yield f"The envelope let it go at {seconds(at_s)}: {flight.breach.text}."
        elif s.fallbacks:
            begun_s = flight.fallback_spans[0][0]
            times = "once" if s.fallbacks == 1 else f"{s.fallbacks} times, first"
            yield f"The fallback took over {times} at {seconds(begun_s)}: {flight.fallen[0].reason}."

    def _blind(self) -> Iterator[str]:
        """Return a sentence on the longest time without a position that was believed, if it was flown blind."""
        flight = self.flight
        begun_s, ended_s = self._longest_silence()
        if ended_s - begun_s <= self._blind_from_s():
            return
        reach_s = flight.design.horizon * flight.design.dt_s
        text = (
            f"It was blind for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} to {seconds(ended_s)}: no "
            f"position that was believed came, and plans reach {number(reach_s, 1)} s."
        )
        drift_m = self._drift_m(begun_s, ended_s)
        if drift_m is not None and drift_m >= GRAVE_M:
            text += f" Meanwhile it drifted {metres(drift_m)} away from its prediction."
        yield text

    def _longest_silence(self) -> tuple[float, float]:
        """Return the longest time without a new position while it was flown [s]."""
        spans = self.flight.spans(FLOWN)
        times = [t for t in self.estimate_s.tolist() if any(begin <= t <= end for begin, end in spans)]
        age_s, at_s = max(((self._age_s(t), t) for t in times), default=(0.0, 0.0))
        return at_s - age_s, at_s

    def _drift_m(self, begun_s: float, ended_s: float) -> float | None:
        """Return how far the true place and the estimate were apart at most in a time; None without a truth."""
        flight = self.flight
        if not flight.truths:
            return None
        true_s = flight.seconds([one.at_ns for one in flight.truths])
        true_m = np.array([one.position_m for one in flight.truths])
        inside = (self.estimate_s >= begun_s) & (self.estimate_s <= ended_s)
        columns = [AXIS_NUMBER[axis] for axis in flight.design.axes]
        believed_m = np.array([flight.design.position_of(e.mean) for e in flight.estimates])[inside][:, columns]
        at_m = np.column_stack([np.interp(self.estimate_s[inside], true_s, true_m[:, one]) for one in columns])
        apart = np.linalg.norm(at_m - believed_m, axis=1)
        return float(apart[np.isfinite(apart)].max(initial=0.0))

    def _off(self) -> Iterator[str]:
        """Return sentences on positions that were refused, and on such as were wrong."""
        refused = [d for d in self.flight.decisions if d.rejected]
        total = sum(d.rejected for d in refused)
        if total > _FEW * max(1, self.summary.accepted):
            first_s = float(self.flight.seconds([refused[0].at_ns])[0])
            yield f"{count(total, 'position')} {'was' if total == 1 else 'were'} refused, first at {seconds(first_s)}."
        wrong = self.wrong_m > _WRONG_M
        if wrong.any():
            worst, first_s = int(self.wrong_m.argmax()), float(self.wrong_s[wrong].min())
            yield (
                f"{count(int(wrong.sum()), 'position')} that came lay over {metres(_WRONG_M)} from the true place, "
                f"first at {seconds(first_s)}; at worst {metres(float(self.wrong_m[worst]))}, at "
                f"{seconds(float(self.wrong_s[worst]))}."
            )

    def _gate(self) -> Iterator[str]:
        """Return a sentence on setpoints that the last gate changed, if these were more than a few."""
        share, first_s, kinds = self._limited()
        if share > _GATE_SHARE:
            names = ", ".join(f"{name} {100 * part:.0f} %" for name, part in kinds)
            yield f"The last gate limited {100 * share:.0f} % of the setpoints ({names}), first at {seconds(first_s)}."

    def _limited(self) -> tuple[float, float, list[tuple[str, float]]]:
        """Return the share of the setpoints that the last gate changed, when first [s], and the shares by name."""
        setpoints = self.flight.setpoints
        changed = [one for one in setpoints if one.limited]
        if not changed:
            return 0.0, 0.0, []
        names = Counter(name for one in changed for name in one.limited)
        first_s = float(self.flight.seconds([changed[0].at_ns])[0])
        kinds = [(name.replace("-", " ", 1), n / len(setpoints)) for name, n in names.most_common(3)]
        return len(changed) / len(setpoints), first_s, kinds

    def _biases(self) -> tuple[Floats, Floats, Floats]:
        """Return times (n,) [s] and biases (n, n_u) estimated while it was flown, and their bounds (n_u,)."""
        flight = self.flight
        n_u = len(flight.design.q_u)
        spans = flight.spans(FLOWN)
        kept = [
            (t, one.bias)
            for t, one in zip(self.estimate_s.tolist(), flight.estimates, strict=True)
            if len(one.bias) == n_u and any(begin <= t < end for begin, end in spans)
        ]
        bounds = np.zeros(0) if self.config is None else np.array(build_estimator(self.config).bias_bounds)
        return np.array([t for t, _ in kept]), np.array([bias for _, bias in kept]).reshape(-1, n_u), bounds

    def _bias(self) -> Iterator[str]:
        """Return a sentence for each axis whose estimated bias was at its bound."""
        t_s, biases, bounds = self._biases()
        if len(bounds) != biases.shape[1]:
            return
        for column, axis in enumerate(self.flight.design.axes):
            bound = float(bounds[column])
            at = np.abs(biases[:, column]) >= _AT_BOUND * bound
            if bound and at.any():
                side = _COMPASS[axis][int(biases[at, column].mean() < 0)]
                lasted_s = int(at.sum()) * self.flight.tick_ns * 1e-9
                unit = self.flight.design.input_unit
                yield (
                    f"The estimated bias was at its bound of {number(bound, 2)} {unit} towards {side} for "
                    f"{seconds(lasted_s)}, first at {seconds(float(t_s[at][0]))}: what pushed was as strong as may be "
                    "flown against, or stronger."
                )

    def _model(self) -> Iterator[str]:
        """Return sentences on wind against the model: what positions showed that nothing sent explains."""
        shown = [(d.unexplained_mps2, d.at_ns) for d in self.flight.decisions if d.unexplained_mps2 is not None]
        bound = None if self.config is None else self.config.envelope.unexplained_mps2
        if shown and bound:
            most, at_ns = max(shown)
            if most > _NEAR_BOUND * bound:
                (at_s,) = self.flight.seconds([at_ns])
                yield (
                    f"Positions showed {most:.1f} m/s² that no setpoint had asked for, at {seconds(at_s)}; "
                    f"{number(bound)} m/s² is what wind and the model's error may make."
                )
        model = self.judged.verdicts.model
        axes = () if model is None else model.axes
        larger, telling = [one for one in axes if one.larger], [one for one in axes if one.telling]
        if larger:
            sizes = ", ".join(f"{one.variance**0.5:.1f} times {one.axis}" for one in larger)
            yield (
                f"Against the model, errors of the forecast were larger than foretold ({sizes}, over "
                f"{larger[0].count} positions): more wind, or noisier positions, than it was made for."
            )
        elif telling:
            found = ", ".join(f"{one.correlation[0]:.1f} {one.axis}".replace("-", "−") for one in telling)
            yield (
                f"Against the model, an error of the forecast tells of the next (correlation {found}, over "
                f"{telling[0].count} positions): wind that stays for a while, or a vehicle that answers otherwise."
            )

    def _solver(self) -> Iterator[str]:
        s = self.summary
        failed = [d for d in self.flight.decisions if d.solve is not None and d.solve.value != "optimal"]
        if failed:
            at_s = float(self.flight.seconds([failed[0].at_ns])[0])
            yield f"{count(len(failed), 'plan')} of {s.solves} came to no optimum, first at {seconds(at_s)}."
        flown = len(self.flight.flown_plans)
        if s.slack_used > _FEW * max(1, flown):
            yield f"In {s.slack_used} of {count(flown, 'plan')} that flew a constraint gave way."

    def _late(self) -> Iterator[str]:
        if self.summary.missed_ticks:
            yield f"{count(self.summary.missed_ticks, 'tick')} of {len(self.flight.decisions)} were missed."

    def _quiet(self) -> str:
        """Return the figures that show that nothing stands behind the headline."""
        begun_s, ended_s = self._longest_silence()
        share = self._limited()[0]
        told = [
            f"the longest time without a position was {ended_s - begun_s:.2f} s (plans reach "
            f"{number(self.flight.design.horizon * self.flight.design.dt_s, 1)} s)",
            f"the last gate limited {100 * share:.0f} % of the setpoints",
        ]
        _, biases, bounds = self._biases()
        if len(biases) and len(bounds) == biases.shape[1] and bounds.any():
            used = np.abs(biases).max(axis=0) / np.where(bounds > 0.0, bounds, np.inf)
            most = int(used.argmax())
            largest, unit = np.abs(biases[:, most]).max(), self.flight.design.input_unit
            told.append(f"the estimated bias was {largest:.2f} of at most {number(float(bounds[most]), 2)} {unit}")
        return f"Nothing stands out: {', '.join(told)}."


def _wrong(flight: FlightData) -> tuple[Floats, Floats]:
    """Return when positions that came were captured (n,) [s], and how far each was from the true place [m].

    Of those that came while the controller flew; none where the truth is unknown.
    """
    samples = [one for each in flight.step_inputs for one in each.samples]
    if len(flight.truths) < 2 or not samples or not flight.spans(FLOWN):
        return np.zeros(0), np.zeros(0)
    true_s = flight.seconds([one.at_ns for one in flight.truths])
    true_m = np.array([one.position_m for one in flight.truths])
    at_s = flight.seconds([one.captured_ns for one in samples])
    columns = [AXIS_NUMBER[axis] for axis in flight.design.axes]
    measured = np.array([one.position_m for one in samples])[:, columns]
    place = np.column_stack([np.interp(at_s, true_s, true_m[:, one]) for one in columns])
    off = np.linalg.norm(measured - place, axis=1)
    known = np.isfinite(off) & (at_s >= true_s[0]) & (at_s <= true_s[-1])
    known &= np.any([(begin <= at_s) & (at_s < end) for begin, end in flight.spans(FLOWN)], axis=0)
    return at_s[known], off[known]
