"""The control loop without its clock and sockets: bytes in, decisions, bytes out.

The daemon runs it in real time, the simulator in lockstep, and replay from a recording. Whatever
it learns and chooses goes to the sink, in the order in which it happened.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from traceback import extract_tb

from msgspec.structs import replace

from uavctl.account import FlightAccount
from uavctl.cause import Cause
from uavctl.config import Config
from uavctl.errors import in_words
from uavctl.event_codes import EventCode
from uavctl.flight.controller import Controller
from uavctl.flight.events import BIAS_AT_BOUND, BIAS_FREE, STRONG_PUSH
from uavctl.flight.monitors.external import CONTROLLER_FAULT
from uavctl.flight.supervise import distrusts_positions
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.mavlink.connection import OVERRUN, MavlinkConnection
from uavctl.mavlink.handover import HAND_OVER_ORDERS, HandoverOutput, HandoverStateMachine
from uavctl.mavlink.handover_guards import HandoverInput, explain_move_refusal
from uavctl.mavlink.handover_states import NOT_LEFT_IN_FLIGHT, HandoverState, SetpointMode
from uavctl.mavlink.messages import CommandAck, Message, StatusText
from uavctl.mavlink.relay import Relay
from uavctl.records import (
    Command,
    ControlMode,
    Datagram,
    Decision,
    Ending,
    Event,
    InertialSample,
    Order,
    Outgoing,
    PositionSample,
    Received,
    Record,
    Refused,
    RelayStats,
    Send,
    Severity,
    Sink,
    StepInput,
    Ticked,
    Timing,
    VehicleMotion,
    VehicleStatus,
    moves_now,
    raw_topic,
)
from uavctl.smpc.plant import Plant

Heard = PositionSample | VehicleStatus | VehicleMotion | InertialSample | CommandAck | StatusText

VEHICLE = "vehicle"
MOCAP = "mocap"
SECOND_NS = 1_000_000_000
FAILED = "the controller has failed:"  # and what failed in it
MAX_ORDERS = 16  # that wait for one tick
FOR_A_PERSON = frozenset(
    {
        EventCode.VEHICLE_TEXT,
        BIAS_AT_BOUND,
        BIAS_FREE,
        STRONG_PUSH,
        CONTROLLER_FAULT,
        EventCode.HUNG_UP,
        EventCode.CONNECTION_SILENT,
        EventCode.NO_HEARTBEAT,
        EventCode.STAMP_UNIT,
    }
)  # codes of the events that the console tells
MISLED_NS = 3_000_000_000  # positions are held back for so long after they could not be the vehicle's own
MAX_INERTIAL = 20  # newest of one tick: their mean is what counts
MAX_SAMPLES = 20  # of one tick, the newest of each source in turn: each costs the estimator its time


def make_links(
    config: Config, on_message: Callable[[Message, int], None] | None = None
) -> dict[str, MavlinkConnection]:
    """The connections' protocol states: one for both roles when the two URLs are the same.

    Args:
        listen: hears every message of others that is understood.
    """
    shared = config.daemon.vehicle == config.daemon.mocap
    names = {VEHICLE: (VEHICLE, MOCAP)} if shared else {VEHICLE: (VEHICLE,), MOCAP: (MOCAP,)}
    return {
        name: MavlinkConnection(
            name,
            roles=frozenset(roles),
            daemon=config.daemon,
            frame=config.frame,
            clock=config.clock,
            source=config.source,
            estimator=config.estimator,
            on_message=on_message,
            vehicle_time=config.relay.enabled and config.relay.vehicle_time,
        )
        for name, roles in names.items()
    }


class ControlLoop:
    """One vehicle's controller with its MAVLink links; implements `uavctl.records.Flyer`.

    `stopwatch` gives nanoseconds for the timing records only; no decision depends on it.
    """

    def __init__(self, config: Config, controller: Controller, sink: Sink, stopwatch: Callable[[], int]) -> None:
        self._controller = controller
        self._put: Callable[[str, int, Record], None] = sink.put
        self._stopwatch = stopwatch
        self._links = make_links(config)
        self._relay, self._relays = Relay(config.relay), config.relay.enabled
        self._hand_over = HandoverStateMachine(config.hand_over, waits_for_landing=config.relay.enabled)
        self._config = config.hand_over
        self._heard: tuple[CommandAck | StatusText, ...] = ()
        self._state = make_initial_state()
        self._inbox: deque[tuple[int, Heard]] = deque()
        self._feels = config.estimator.inertial_std_mps2 > 0.0
        self._inertial: tuple[InertialSample, ...] = ()
        self._next_stats_ns: int | None = None
        self._unsure_since_ns: int | None = None  # time since which the vehicle's messages may have been lost unread
        self._vehicle: VehicleStatus | None = None
        self._motion: VehicleMotion | None = None
        self._decision: Decision | None = None
        self._orders: deque[Command] = deque()
        self._answered_ns = 0  # time that a controller of another package took in the last tick
        # The last time at which positions could not be those of the vehicle on its way up or down; None before.
        self._misled_ns: int | None = None
        self._adrift = False  # not even the hand-over works any more: positions are all that is sent
        self._controlled_ns: int | None = None  # the last setpoint that flew the vehicle
        self._lands = config.fallback.land or config.relay.enabled
        self.account = FlightAccount()  # course of the flight, as far as it bears upon the end

    @property
    def ending(self) -> Ending:
        """End of the flight, or the one that it would have now."""
        return replace(self.account.compute_ending(is_over=self.finished), relay=self._relayed())

    def _relayed(self) -> str:
        """Return a text for a person on the positions passed on to the vehicle."""
        stats = self.relay
        if stats is None or stats.last_ns is None:
            return "" if stats is None else "no position was passed on to the vehicle"
        before_s = (stats.at_ns - stats.last_ns) * 1e-9
        kept = sum(stats.kept.values())
        text = f"passed on {stats.sent} positions and kept {kept} back, the last one {before_s:.1f} s before the end"
        longer_s = 0.0 if self._controlled_ns is None else (stats.last_ns - self._controlled_ns) * 1e-9
        return f"{text}, {longer_s:.1f} s after the last setpoint" if longer_s > 0.0 else text

    @property
    def finished(self) -> bool:
        """Whether the vehicle has been handed over and nothing more will be sent."""
        if self._adrift:
            return not self._hand_over.is_relay_needed
        over = self._decision is not None and self._decision.mode in (ControlMode.LAND, ControlMode.STOPPED)
        return self._hand_over.is_finished or (over and not self._hand_over.is_busy)

    @property
    def is_relay_needed(self) -> bool:
        """Whether a vehicle is in the air by the positions that are relayed to it."""
        return self._hand_over.is_relay_needed

    @property
    def relay(self) -> RelayStats | None:
        """Counts of the positions passed on to the vehicle; None where none are passed on."""
        if not self._relays:
            return None
        kept = {reason: count for reason, count in self._relay.kept.items() if count}
        at_ns = 0 if self._decision is None else self._decision.at_ns
        alone = bool(self.account.control_error) or (self._controlled_ns is not None and self._controlled_ns < at_ns)
        relay = self._relay
        return RelayStats(
            at_ns=at_ns, sent=relay.sent, kept=kept, last_ns=relay.last_ns, alone=alone, silent_for=relay.silent_for
        )

    @property
    def inertial(self) -> tuple[int, int] | None:
        """Inertial data of the vehicle that are used, and all that came; None where none are used."""
        return self._links[VEHICLE].inertial_counts if self._feels else None

    @property
    def plant(self) -> Plant:
        """The model by which the vehicle's state is estimated."""
        return self._controller.plant

    @property
    def failure(self) -> str:
        """Request that the vehicle did not carry out, with its own reason; empty if it did all."""
        return self._hand_over.failure

    @property
    def let_go(self) -> str:
        """Reason why the envelope let the vehicle go: what was seen and cannot be; empty as long as nothing was."""
        return "" if self._state.monitors.release is None else self._state.monitors.release.text

    @property
    def handover_state(self) -> HandoverState:
        """State of the hand-over."""
        return self._hand_over.state

    @property
    def leaves_vehicle(self) -> bool | None:
        """Whether a vehicle would be left behind that has flown on our setpoints; None before one is heard."""
        return None if self.handover_state is HandoverState.WAITING else self.handover_state not in NOT_LEFT_IN_FLIGHT

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take one datagram that arrived at `at_ns`; of positions, ticks before that time see nothing."""
        self._put(raw_topic(link, outgoing=False), at_ns, Datagram(at_ns=at_ns, link=link, outgoing=False, data=data))
        from_vehicle = from_source = False
        news: tuple[Event, ...] = ()
        understood = self._links[link].receive(data, at_ns)
        for item in understood.items:
            from_vehicle = from_vehicle or isinstance(item, VehicleStatus)
            if isinstance(item, Event):
                self._put("/uavctl/event", at_ns, item)
                news = (*news, item) if item.code in FOR_A_PERSON else news
            elif self._feels or not isinstance(item, InertialSample):
                self._inbox.append((at_ns, item))
            if isinstance(item, PositionSample):
                from_source = understood.is_source_settled
                if self._relays:
                    self._relay.add_sample(item, understood.attitude)
        asked = understood.replies
        answers = tuple([self._outgoing(link, answer, at_ns) for answer in asked]) if asked else ()
        return Received(answers, from_vehicle, from_source, news)

    def refused(self, link: str, counts: dict[str, int], at_ns: int) -> tuple[Event, ...]:
        """Take note that a connection has dropped datagrams unread, and return what a person is to be told of it.

        Where that was the vehicle's, it may have been that the pilot has taken over: nothing that moves the vehicle is
        sent until it is heard again.
        """
        self._put("/uavctl/refused", at_ns, Refused(at_ns=at_ns, link=link, counts=counts))
        if link == VEHICLE and counts.keys() & {EventCode.HUNG_UP, OVERRUN}:
            self._unsure_since_ns = at_ns
        events = self._links[link].add_refusals(counts, at_ns)
        for event in events:
            self._put("/uavctl/event", at_ns, event)
        return tuple([event for event in events if event.code in FOR_A_PERSON])

    def tick(self, tick: int, at_ns: int, send: Send, missed_ticks: int = 0, stop: bool = False) -> Ticked:
        """Run the control tick of grid time `at_ns`.

        Args:
            send: is given the bytes to send, each as soon as it is known: heartbeats and TIMESYNC before the decision,
                so that a solve does not delay a round trip.
        """
        inp = self._gather(tick, at_ns, missed_ticks, stop)
        if stop:
            self.account.note_requested_end(Cause.ENDED_BY_OPERATOR)  # unless who asks has said why
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(self._outgoing(name, data, at_ns))
        notices: list[Event] = []
        begun = self._stopwatch()
        out = self._decide(inp, notices)
        step_ns = self._stopwatch() - begun
        self._decision = out.decision
        self._record(out, at_ns)
        self.account.release_reason = self.let_go
        self.account.update_vehicle(at_ns, self._vehicle)
        self.account.add_decision(out.decision, out.events, has_estimate=out.estimate is not None)
        # A vehicle that climbs or lands must not do so by positions that have just been found to be wrong.
        if out.position_inconsistent and self._hand_over.has_begun:
            self._misled_ns = at_ns
        misled = self._misled_ns is not None and at_ns - self._misled_ns < MISLED_NS
        held_back = misled or distrusts_positions(self._state)
        if self._relays and not held_back:
            for data in self._links[VEHICLE].encode_relayed_poses(
                self._relay, at_ns, refused=inp.samples if out.newest_inconsistent else out.refused
            ):
                send(self._outgoing(VEHICLE, data, at_ns))
        if self._relays and self._vehicle is not None:
            silence = self._relay.make_event(at_ns, held_back=held_back, armed=self._vehicle.armed)
            if silence is not None:
                self._put("/uavctl/event", at_ns, silence)
                notices.append(silence)
        answers: tuple[tuple[Command, Event], ...] = ()
        if self._adrift:
            self._hand_over.update_airborne(at_ns, self._vehicle)
        else:
            outgoing: list[Outgoing] = []  # what fails in `send` is no failure of the controller
            try:
                told = self._hand_over.update(self._view(inp, out))
                answers = tuple(self._answers(inp.commands, out.events, told.events)) if inp.commands else ()
                notices += self._noted(told, at_ns)
                self._command(told, out, at_ns, outgoing.append)
            except Exception as error:  # noqa: BLE001 the vehicle may be in the air by the positions that it gets
                self._adrift = True
                notices.append(self._die(error, at_ns))
            for one in outgoing:
                send(one)
        self.account.is_over = self.finished
        self._record_stats(at_ns)
        return Ticked(
            decision=out.decision,
            estimate=out.estimate,
            link=out.link,
            vehicle=self._vehicle,
            answers=answers,
            news=tuple([event for event in out.events if event.code in FOR_A_PERSON]),
            notices=tuple(notices),
            step_ns=step_ns,
        )

    def _decide(self, inp: StepInput, notices: list[Event]) -> TickOutput:
        """Run the core for a tick; a core that has failed is not run again, and the vehicle it flew has to land."""
        if not self.account.control_error:
            try:
                self._state, out = run_tick(self._state, inp, self._controller, carried=self._hand_over.has_begun)
            except Exception as error:  # noqa: BLE001 the vehicle may be in the air by the positions that it gets
                notices.append(self._die(error, inp.at_ns))
                return self._without_core(inp, land=self._lands or self._hand_over.is_ordered_flight)
            return out
        return self._without_core(inp, land=False)

    def _without_core(self, inp: StepInput, *, land: bool) -> TickOutput:
        """A tick of a controller that has failed: nothing is decided; once, the vehicle's own landing is asked for."""
        decision = Decision(
            tick=inp.tick,
            at_ns=inp.at_ns,
            step=0 if self._decision is None else self._decision.step,
            boundary=False,
            mode=ControlMode.STOPPED,
            age_steps=None,
            news=False,
            plan_seq=None,
            plan_index=None,
            solve=None,
            input=None,
            fresh=0,
            missed_ticks=inp.missed_ticks,
            accepted=0,
            rejected=0,
            reason=f"{FAILED} {self.account.control_error}",
        )
        return TickOutput(estimate=None, plan=None, decision=decision, setpoint=None, events=(), land=land)

    def _die(self, error: Exception, at_ns: int) -> Event:
        """Note that the controller has failed: no setpoint is sent any more; positions still go to the vehicle.

        Returns:
            The event that tells it, for a person.
        """
        last = next(reversed(extract_tb(error.__traceback__)), None)
        where = "" if last is None else f" ({last.filename.rpartition('/')[2]}, line {last.lineno})"
        self.account.control_error = self.account.control_error or f"{in_words(error)}{where}"
        event = Event(
            at_ns=at_ns,
            severity=Severity.ERROR,
            code=EventCode.CONTROL_FAILED,
            text=f"{FAILED} {self.account.control_error}",
        )
        self._put("/uavctl/event", at_ns, event)
        return event

    def order(self, command: Command) -> bool:
        """Queue an order of the operator for the next tick; False if too many wait already."""
        if len(self._orders) >= MAX_ORDERS:
            return False
        self._orders.append(command)
        self.account.takes_off = self.account.takes_off or command.order is Order.TAKE_OFF
        return True

    @property
    def outside(self) -> str:
        """Name of the controller of another package that plans; empty where one of ours does."""
        return self._controller.outside

    def answered(self, took_ns: int) -> None:
        """Take note of how long that one took for the plan of the last tick; the next one judges it."""
        self._answered_ns = took_ns

    def explain_refusal(self, order: Order) -> str:
        """Return why an order of where to fly would have no effect now; empty if it may be taken, or is another one."""
        moves = order in (Order.GOTO, Order.HOLD, Order.RESUME)
        return explain_move_refusal(self.handover_state, self._vehicle) if moves else ""

    def timing(self, ticked: Ticked, lateness_ns: int, send_ns: int) -> None:
        """Record what the shell measured around a tick."""
        estimate, at_ns = ticked.estimate, ticked.decision.at_ns
        self._put(
            "/uavctl/timing",
            at_ns,
            Timing(
                tick=ticked.decision.tick,
                at_ns=at_ns,
                lateness_ns=lateness_ns,
                step_ns=ticked.step_ns,
                send_ns=send_ns,
                capture_to_send_ns=None if estimate is None else at_ns + send_ns - estimate.captured_ns,
            ),
        )

    def _gather(self, tick: int, at_ns: int, missed_ticks: int, stop: bool) -> StepInput:
        """Gather the inputs of the tick; they are recorded first, so that a replay knows when the tick ran."""
        samples, heard, self._heard = self._take_due(at_ns)
        inp = StepInput(
            tick=tick,
            at_ns=at_ns,
            samples=samples,
            vehicle=self._hand_over.select_controlled_status(at_ns, self._vehicle),
            motion=self._motion,
            inertial=self._inertial,
            missed_ticks=missed_ticks,
            stop=stop,
            commands=tuple(self._orders),
            answered_ns=self._answered_ns,
        )
        self._orders.clear()
        self._answered_ns = 0
        self._put("/uavctl/step_input", at_ns, inp)
        for status in heard:
            self._put("/uavctl/vehicle", status.at_ns, status)
        return inp

    def _take_due(
        self, at_ns: int
    ) -> tuple[tuple[PositionSample, ...], tuple[VehicleStatus, ...], tuple[CommandAck | StatusText, ...]]:
        """Samples that arrived up to `at_ns`, and all that the vehicle has said: its newest state is taken over.

        What it says counts in a late tick too, when it came after the time of the tick: it may be that the pilot flies.
        That he does is not overtaken by a later word in the same backlog.
        """
        samples: list[PositionSample] = []
        heard: list[VehicleStatus] = []
        words: list[CommandAck | StatusText] = []
        felt: list[InertialSample] = []
        waiting: deque[tuple[int, Heard]] = deque()
        for received_ns, item in self._inbox:
            if isinstance(item, VehicleStatus):
                heard.append(item)
            elif isinstance(item, VehicleMotion):
                self._motion = item
            elif not isinstance(item, PositionSample | InertialSample):
                words.append(item)
            elif received_ns <= at_ns and isinstance(item, InertialSample):
                felt.append(item)
            elif received_ns <= at_ns and isinstance(item, PositionSample):
                samples.append(item)
            else:
                waiting.append((received_ns, item))
        self._inbox, self._inertial = waiting, tuple(felt[-MAX_INERTIAL:])
        flown = self._hand_over.state is HandoverState.ENGAGED
        left = [status for status in heard if flown and self._hand_over.has_left_external_mode(status)]
        # Of the mode that it left for the newest word counts: it may say who has chosen it.
        left = [status for status in left if status.mode == left[0].mode]
        self._vehicle = next(iter((left or heard)[::-1]), self._vehicle)
        if heard and self._unsure_since_ns is not None and heard[-1].at_ns > self._unsure_since_ns:
            self._unsure_since_ns = None
        return _newest_of_each(samples), tuple(heard), tuple(words)

    def _record(self, out: TickOutput, at_ns: int) -> None:
        if out.estimate is not None:
            self._put("/uavctl/estimate", at_ns, out.estimate)
        if out.link is not None:
            self._put("/uavctl/link_estimate", at_ns, out.link)
        if out.plan is not None:
            self._put("/uavctl/plan", at_ns, out.plan)
        self._put("/uavctl/decision", at_ns, out.decision)
        for event in out.events:
            self._put("/uavctl/event", at_ns, event)

    def _noted(self, told: HandoverOutput, at_ns: int) -> Iterator[Event]:
        """Note what the hand-over did; yields what a person has to be told of it: whoever ordered gets the answer."""
        if told.transition is not None:
            self.account.add_transition(told.transition, self._vehicle)
        for event in told.events:
            self._put("/uavctl/event", at_ns, event)
            if event.severity is not Severity.INFO and event.code != EventCode.ORDER_REFUSED:
                yield event

    def _command(self, told: HandoverOutput, out: TickOutput, at_ns: int, send: Send) -> None:
        """Send the vehicle what the hand-over wants: a setpoint, a request, or nothing."""
        link = self._links[VEHICLE]
        sure = self._unsure_since_ns is None
        if sure and told.setpoint_mode is not SetpointMode.NOTHING and out.setpoint is not None:
            self._put("/uavctl/setpoint", at_ns, out.setpoint)
            if told.setpoint_mode is SetpointMode.SETPOINTS:
                self._controlled_ns = at_ns
            send(self._outgoing(VEHICLE, link.encode_setpoint(out.setpoint), at_ns))
        if sure and told.request is not None:
            send(self._outgoing(VEHICLE, link.encode_request(told.request, self._hand_over.height_m), at_ns))
        if self._hand_over.is_ordered_flight and self._hand_over.state in (
            HandoverState.READY,
            HandoverState.MODE,
            HandoverState.ARMING,
        ):
            for data in link.setup_global_origin(at_ns, self._config.origin_deg_m):
                send(self._outgoing(VEHICLE, data, at_ns))

    def _answers(
        self, commands: tuple[Command, ...], core: tuple[Event, ...], hand_over: tuple[Event, ...]
    ) -> Iterator[tuple[Command, Event]]:
        """Each order with its answer; a landing that the core does not fly, and the hand-over asks for, is accepted."""
        for command, event in _answered(commands, core, hand_over):
            landing = (
                command.order is Order.LAND
                and event.code == EventCode.ORDER_REFUSED
                and self.handover_state is HandoverState.LANDING
            )
            text = "land: the vehicle is asked for it"
            yield (
                command,
                replace(event, severity=Severity.INFO, code=EventCode.ORDER_ACCEPTED, text=text) if landing else event,
            )

    def _view(self, inp: StepInput, out: TickOutput) -> HandoverInput:
        """Return the inputs of the hand-over in this tick."""
        plant, estimate = self._controller.plant, out.estimate
        up_m, up_mps = None, 0.0
        if estimate is not None and "down" in plant.axes:
            down = plant.axes.index("down")
            up_m, up_mps = -estimate.mean[plant.position_index[down]], -estimate.mean[plant.velocity_index[down]]
        unfit = ""
        if out.setpoint is None or estimate is None:
            unfit = "the controller has no estimate of the position"
        elif estimate.age_s > self._config.fresh_s:
            unfit = f"the newest position is {estimate.age_s:.1f} s old"
        return HandoverInput(
            at_ns=inp.at_ns,
            vehicle=self._vehicle,
            uptime_s=self._links[VEHICLE].vehicle_uptime_s(inp.at_ns),
            has_setpoint=out.setpoint is not None,
            is_landing_requested=out.land,
            is_stop_requested=inp.stop,
            may_have_lost_messages=self._unsure_since_ns is not None,
            arming_refusal=unfit,
            climb_hazard=out.unsafe_to_climb,
            estimated_height_m=up_m,
            climb_rate_mps=up_mps,
            has_motion=moves_now(self._motion, inp.at_ns),
            messages=self._heard,
            commands=inp.commands,
        )

    def _outgoing(self, link: str, data: bytes, at_ns: int) -> Outgoing:
        """Bytes that are about to be sent, recorded as such."""
        self._put(raw_topic(link, outgoing=True), at_ns, Datagram(at_ns=at_ns, link=link, outgoing=True, data=data))
        return Outgoing(link=link, data=data)

    def _record_stats(self, at_ns: int) -> None:
        if self._next_stats_ns is None:
            self._next_stats_ns = at_ns
        if at_ns >= self._next_stats_ns:
            self._next_stats_ns = at_ns + SECOND_NS
            for link in self._links.values():
                self._put("/uavctl/link", at_ns, link.stats(at_ns))
            relay = self.relay
            if relay is not None:
                self._put("/uavctl/relay", at_ns, relay)


def _newest_of_each(samples: list[PositionSample]) -> tuple[PositionSample, ...]:
    """Return as many samples as a tick may look at, in order; a source that sends many takes no room of another's."""
    if len(samples) <= MAX_SAMPLES:
        return tuple(samples)
    behind: Counter[str] = Counter()  # newer samples of the same source
    ranks = [0] * len(samples)
    for place in range(len(samples) - 1, -1, -1):
        ranks[place] = behind[samples[place].source]
        behind[samples[place].source] += 1
    chosen = sorted(range(len(samples)), key=lambda place: (ranks[place], -place))[:MAX_SAMPLES]
    return tuple(samples[place] for place in sorted(chosen))


def _answered(
    commands: tuple[Command, ...], core: Iterable[Event], hand_over: Iterable[Event]
) -> Iterator[tuple[Command, Event]]:
    """Each order with the event that answers it; the core and the hand-over answer their own, in order."""
    mine, theirs = (
        iter([event for event in events if event.code in (EventCode.ORDER_ACCEPTED, EventCode.ORDER_REFUSED)])
        for events in (hand_over, core)
    )
    for command in commands:
        answer = next(mine if command.order in HAND_OVER_ORDERS else theirs, None)
        if answer is not None:
            yield command, answer
