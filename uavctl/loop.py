"""The control loop without its clock and sockets: bytes in, decisions, bytes out.

The daemon runs it in real time, the simulator in lockstep, and replay from a recording. All
measurements and decisions go to the sink, in their order.

One tick: 1. gather and record the inputs; 2. send due messages of the connections; 3. run the core (`flight.tick`);
4. relay positions to the vehicle; 5. update the hand-over; 6. send a setpoint or a request, and answer orders.
A core that fails is not run again: no setpoint is sent from then on, and the vehicle is asked to land. If the hand-over
fails, or whole ticks do, a landing request of its own is sent until it is answered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from traceback import extract_tb

from msgspec.structs import replace

from uavctl.account import FlightAccount
from uavctl.arrays import SECOND_NS
from uavctl.cause import Cause
from uavctl.cell_report import find_conduct, has_landed, make_report
from uavctl.config import Config
from uavctl.errors import TickOverdueError, in_words
from uavctl.event_codes import EventCode
from uavctl.fleet.cell import NO_CELL, CellChoice, parse_cell
from uavctl.flight.context import read_velocity
from uavctl.flight.controller import Controller
from uavctl.flight.supervise import distrusts_positions
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.inbox import Inbox
from uavctl.mavlink.connection import OVERRUN, VEHICLE, make_links
from uavctl.mavlink.handover import HAND_OVER_ORDERS, HandoverOutput, HandoverStateMachine
from uavctl.mavlink.handover_guards import HandoverInput, explain_move_refusal, explain_take_off_refusal
from uavctl.mavlink.handover_states import NOT_LEFT_IN_FLIGHT, HandoverState, SetpointMode
from uavctl.mavlink.landing import LandingRequest, LandingTarget
from uavctl.mavlink.messages import CommandAck, StatusText
from uavctl.mavlink.relay import Relay, describe_relay
from uavctl.records import (
    CellMessage,
    CellReport,
    Command,
    Conduct,
    ControlMode,
    Datagram,
    Decision,
    Ending,
    Estimate,
    Event,
    InertialSample,
    InternalError,
    InternalErrorEffect,
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
    discard,
    moves_now,
    raw_topic,
)
from uavctl.smpc.plant import Plant

CONTROL_FAILED_TEXT = "the controller has failed:"  # then the error
CONSOLE_CODES = frozenset(
    {
        EventCode.VEHICLE_TEXT,
        EventCode.BIAS_AT_BOUND,
        EventCode.BIAS_FREE,
        EventCode.STRONG_PUSH,
        EventCode.POSITIONS_LATE,
        EventCode.CONTROLLER_FAULT,
        EventCode.HUNG_UP,
        EventCode.CONNECTION_SILENT,
        EventCode.PROCESS_ENDED,
        EventCode.SEVERAL_PUBLISHERS,
        EventCode.NO_HEARTBEAT,
        EventCode.STAMP_UNIT,
        EventCode.INTERNAL_ERROR,
    }
)  # codes of events that the console shows
FROZEN_TEXT = "The camera repeats one position although the vehicle moves. The controller ignores these positions."
FROZEN_PAUSE_NS = 3_000_000_000  # without frozen positions: the next ones are a new series
INCONSISTENT_HOLD_NS = 3_000_000_000  # time in which positions are held back after such a contradiction


class ControlLoop:
    """Controller of one vehicle, with its MAVLink connections; implements `uavctl.records.Flyer`.

    Args:
        stopwatch: Returns nanoseconds, for timing records only; no decision depends on it.
    """

    def __init__(self, config: Config, controller: Controller, sink: Sink, stopwatch: Callable[[], int]) -> None:
        self._controller = controller
        self._put: Callable[[str, int, Record], None] = sink.put
        self._stopwatch = stopwatch
        self._links = make_links(config)
        self._relay, self._is_relay_enabled = Relay(config.relay), config.relay.enabled
        self._hand_over = HandoverStateMachine(config.hand_over, waits_for_landing=config.relay.enabled)
        self._handover_config = config.hand_over
        self._vehicle_messages: tuple[CommandAck | StatusText, ...] = ()
        self._statuses: tuple[VehicleStatus, ...] = ()  # that the vehicle has sent for this tick
        self._state = make_initial_state()
        self._inbox = Inbox()
        self._uses_inertial = config.estimator.inertial_std_mps2 > 0.0
        self._next_stats_ns: int | None = None
        self._messages_lost_ns: int | None = None  # time since which the vehicle's messages may have been lost unread
        self._vehicle: VehicleStatus | None = None
        self._motion: VehicleMotion | None = None
        self._decision: Decision | None = None
        self._estimate: Estimate | None = None
        self._external_solve_ns = 0  # time that a controller of another package took in the last tick
        self._frozen_ns: int | None = None  # the last tick with frozen positions
        # The last tick in which positions contradicted the vehicle's climb or landing
        self._position_inconsistent_ns: int | None = None
        # Not even the hand-over works any more: positions and a landing request are all that is sent.
        self._is_handover_failed = False
        self._is_landing_due = False  # control has failed, and the hand-over has not been told yet
        self._landing_request = LandingRequest((config.daemon.system_id, config.daemon.component_id), config.hand_over)
        self._last_setpoint_ns: int | None = None  # the last setpoint that flew the vehicle
        self._lands_on_failure = config.fallback.land or config.relay.enabled
        self.on_datagram: Callable[[str, bytes, int], None] = lambda *_: None  # link, data, time of arrival [ns]
        self.account = FlightAccount()

    @property
    def ending(self) -> Ending:
        """Ending of the flight, or the one that it would have now."""
        stats = self.relay
        relay_text = "" if stats is None else describe_relay(stats, self._last_setpoint_ns)
        return replace(self.account.compute_ending(is_over=self.finished), relay=relay_text)

    @property
    def finished(self) -> bool:
        """Whether the vehicle has been handed over and nothing more will be sent."""
        if self._is_handover_failed:
            return not (self._hand_over.is_relay_needed or self._landing_request.is_pending)
        if self._is_landing_due:
            return False
        is_core_over = self._decision is not None and self._decision.mode in (ControlMode.LAND, ControlMode.STOPPED)
        return self._hand_over.is_finished or (is_core_over and not self._hand_over.is_busy)

    @property
    def is_relay_needed(self) -> bool:
        """Whether a vehicle is in the air by the positions that are relayed to it."""
        return self._hand_over.is_relay_needed

    @property
    def relay(self) -> RelayStats | None:
        """Counts of the positions passed on to the vehicle; None where none are passed on."""
        if not self._is_relay_enabled:
            return None
        at_ns = 0 if self._decision is None else self._decision.at_ns
        has_control_ended = self._last_setpoint_ns is not None and self._last_setpoint_ns < at_ns
        return self._relay.stats(at_ns, alone=bool(self.account.control_error) or has_control_ended)

    @property
    def inertial(self) -> tuple[int, int] | None:
        """Inertial data of the vehicle that are used, and all that came; None where none are used."""
        return self._links[VEHICLE].inertial_counts if self._uses_inertial else None

    @property
    def plant(self) -> Plant:
        """The model by which the vehicle's state is estimated."""
        return self._controller.plant

    @property
    def failure(self) -> str:
        """Request that the vehicle did not carry out, with its own reason; empty if it did all."""
        return self._hand_over.failure

    @property
    def breach_reason(self) -> str:
        """Reason why the envelope has let the vehicle go; empty while it has not."""
        return "" if self._state.monitors.breach is None else self._state.monitors.breach.text

    @property
    def handover_state(self) -> HandoverState:
        """State of the hand-over."""
        return self._hand_over.state

    @property
    def leaves_vehicle(self) -> bool | None:
        """Whether a vehicle would be left behind that has flown on our setpoints; None before one is heard."""
        return None if self.handover_state is HandoverState.WAITING else self.handover_state not in NOT_LEFT_IN_FLIGHT

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Receive one datagram that arrived at `at_ns`; ticks before that time use none of its positions."""
        self._put(raw_topic(link, outgoing=False), at_ns, Datagram(at_ns=at_ns, link=link, outgoing=False, data=data))
        try:
            self.on_datagram(link, data, at_ns)
            return self._handle_data(link, data, at_ns)
        except Exception as error:  # noqa: BLE001 one datagram ends no flight; a link that is not heard does in order
            event = self._make_error_event(f"link {link}: a datagram: {_describe_error(error)}", at_ns)
            return Received((), False, False, (event,))

    def _handle_data(self, link: str, data: bytes, at_ns: int) -> Received:
        """Pass the messages of a datagram on to the next tick; return replies and events."""
        if link == VEHICLE:
            self._landing_request.receive(data)
        from_vehicle = from_source = False
        console_events: tuple[Event, ...] = ()
        received = self._links[link].receive(data, at_ns)
        for item in received.items:
            match item:
                case Event():
                    self._put("/uavctl/event", at_ns, item)
                    console_events = (*console_events, item) if item.code in CONSOLE_CODES else console_events
                    continue
                case VehicleStatus():
                    from_vehicle = True
                case InertialSample() if not self._uses_inertial:
                    continue
                case PositionSample():
                    from_source = received.is_source_settled
                    if self._is_relay_enabled:
                        self._relay.add_sample(item, received.attitude)
            self._inbox.add(item, at_ns)
        replies = received.replies
        answers = tuple([self._record_outgoing(link, answer, at_ns) for answer in replies]) if replies else ()
        return Received(answers, from_vehicle, from_source, console_events)

    def add_refusals(self, link: str, counts: dict[str, int], at_ns: int) -> tuple[Event, ...]:
        """Add counts of datagrams that a connection has dropped unread; return its events for the console.

        A dropped message of the vehicle may have reported that the pilot took over. So nothing that moves the vehicle
        is sent until its next heartbeat.
        """
        self._put("/uavctl/refused", at_ns, Refused(at_ns=at_ns, link=link, counts=counts))
        if link == VEHICLE and counts.keys() & {EventCode.HUNG_UP, OVERRUN}:
            self._messages_lost_ns = at_ns
        events = self._links[link].add_refusals(counts, at_ns)
        for event in events:
            self._put("/uavctl/event", at_ns, event)
        return tuple([event for event in events if event.code in CONSOLE_CODES])

    def tick(
        self, tick: int, at_ns: int, send: Send, missed_ticks: int = 0, stop: bool = False, core_error: str = ""
    ) -> Ticked:
        """Run the control tick of grid time `at_ns`.

        Args:
            send: Called with the bytes to send, each as soon as it is known: heartbeats and TIMESYNC before the
                decision, so that a solve does not delay a round trip.
            core_error: Recorded error of the core in this tick: it fails with that, and is not run.
        """
        return self.run_inputs(self.gather_inputs(tick, at_ns, missed_ticks, stop), send, core_error)

    def run_inputs(self, inputs: StepInput, send: Send, core_error: str = "") -> Ticked:
        """Run a tick with its inputs: those that were gathered, or in their place other measurements; see `tick`.

        The inputs are recorded first, so that a replay knows when the tick ran.
        """
        at_ns = inputs.at_ns
        self._put("/uavctl/step_input", at_ns, inputs)
        for status in self._statuses:
            self._put("/uavctl/vehicle", status.at_ns, status)
        if inputs.stop:
            self.account.note_requested_end(Cause.ENDED_BY_OPERATOR)  # unless who asks has said why
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(self._record_outgoing(name, data, at_ns))
        notices: list[Event] = []
        begin_ns = self._stopwatch()
        output = self._run_core(inputs, notices, core_error)
        step_ns = self._stopwatch() - begin_ns
        self._decision, self._estimate = output.decision, output.estimate
        self._record_output(output, at_ns)
        self.account.breach_reason = self.breach_reason
        self.account.update_vehicle(at_ns, self._vehicle)
        self.account.add_decision(output.decision, output.events, has_estimate=output.estimate is not None)
        self._notice_frozen_positions(output, notices)
        self._relay_positions(inputs, output, send, notices)
        answers = self._update_handover(inputs, output, send, notices)
        self.account.is_over = self.finished
        self._record_stats(at_ns)
        return Ticked(
            decision=output.decision,
            estimate=output.estimate,
            link=output.link,
            vehicle=self._vehicle,
            answers=answers,
            console_events=tuple([event for event in output.events if event.code in CONSOLE_CODES]),
            notices=tuple(notices),
            step_ns=step_ns,
        )

    def _notice_frozen_positions(self, output: TickOutput, notices: list[Event]) -> None:
        """Notice positions that begin to repeat; each series of them once."""
        for event in output.events:
            if event.code == EventCode.SAMPLE_FROZEN:
                if self._frozen_ns is None or event.at_ns - self._frozen_ns >= FROZEN_PAUSE_NS:
                    notices.append(replace(event, text=FROZEN_TEXT))
                self._frozen_ns = event.at_ns

    def _relay_positions(self, inputs: StepInput, output: TickOutput, send: Send, notices: list[Event]) -> None:
        """Pass positions on to the vehicle, but those that contradict its climb or landing."""
        at_ns = inputs.at_ns
        if output.position_inconsistent and self._hand_over.is_climbing_or_landing:
            self._position_inconsistent_ns = at_ns
        if not self._is_relay_enabled:
            return
        since_ns = self._position_inconsistent_ns
        is_inconsistent = since_ns is not None and at_ns - since_ns < INCONSISTENT_HOLD_NS
        is_held_back = is_inconsistent or distrusts_positions(self._state)
        if not is_held_back:
            refused = inputs.samples if output.newest_inconsistent else output.refused
            for data in self._links[VEHICLE].encode_relayed_poses(self._relay, at_ns, refused=refused):
                send(self._record_outgoing(VEHICLE, data, at_ns))
        if self._vehicle is not None:
            silence = self._relay.make_event(at_ns, held_back=is_held_back, armed=self._vehicle.armed)
            for event in (self._relay.make_attitude_event(at_ns), silence):
                if event is not None:
                    self._put("/uavctl/event", at_ns, event)
                    notices.append(event)

    def _update_handover(
        self, inputs: StepInput, output: TickOutput, send: Send, notices: list[Event]
    ) -> tuple[tuple[Command, Event], ...]:
        """Update the hand-over and send its requests; return each order with its answer."""
        if self._is_handover_failed:
            self._hand_over.update_airborne(inputs.at_ns, self._vehicle)
            self._send_landing_request(inputs.at_ns, send)
            return ()
        answers: tuple[tuple[Command, Event], ...] = ()
        outgoing: list[Outgoing] = []  # what fails in `send` is no failure of the controller
        try:
            handover_output = self._hand_over.update(self._make_handover_input(inputs, output))
            self._is_landing_due = self._is_landing_due and not output.land
            answers = tuple(self._match_answers(inputs.commands, output.events, handover_output.events))
            notices += self._record_handover(handover_output, inputs.at_ns)
            self._send_commands(handover_output, output, inputs.at_ns, outgoing.append)
        except Exception as error:  # noqa: BLE001 the vehicle may be in the air by the positions that it gets
            self._is_handover_failed = True
            notices.append(self._fail(_describe_error(error), inputs.at_ns))
            self._send_landing_request(inputs.at_ns, send)
        for datagram in outgoing:
            send(datagram)
        return answers

    def _run_core(self, inputs: StepInput, notices: list[Event], core_error: str) -> TickOutput:
        """Run the core for a tick. A core that has failed is not run again; the vehicle that it flew is to land.

        Landing is asked for in the next tick: the vehicle's state is too old to send where the core took long.
        """
        has_failed = bool(self.account.control_error)
        if core_error:
            notices.append(self._fail_core(core_error, inputs.at_ns))
        if not self.account.control_error:
            try:
                self._state, output = run_tick(
                    self._state, inputs, self._controller, is_climbing_or_landing=self._hand_over.is_climbing_or_landing
                )
            except (Exception, TickOverdueError) as error:  # noqa: BLE001 the vehicle may fly by relayed positions
                notices.append(self._fail_core(_describe_error(error), inputs.at_ns))
            else:
                return output
        return self._make_failed_output(inputs, land=self._is_landing_due and has_failed)

    def _make_failed_output(self, inputs: StepInput, *, land: bool) -> TickOutput:
        """Make the output of a tick after the core has failed: no setpoint; `land` asks the vehicle to land."""
        decision = Decision(
            tick=inputs.tick,
            at_ns=inputs.at_ns,
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
            missed_ticks=inputs.missed_ticks,
            accepted=0,
            rejected=0,
            reason=f"{CONTROL_FAILED_TEXT} {self.account.control_error}",
        )
        return TickOutput(estimate=None, plan=None, decision=decision, setpoint=None, events=(), land=land)

    def fail(self, error: BaseException, at_ns: int) -> Event:
        """Note an error of a whole cycle, and return its event: no setpoint is sent, landing is asked for."""
        return self.handle_failure(
            InternalError(at_ns=at_ns, text=_describe_error(error), effect=InternalErrorEffect.CONTROL), discard
        )

    def note_error(self, subject: str, error: Exception, at_ns: int) -> Event:
        """Note an error that the flight can do without; return the event."""
        text = f"{subject}: {_describe_error(error)}; the flight continues"
        return self.handle_failure(InternalError(at_ns=at_ns, text=text, effect=InternalErrorEffect.NONE), discard)

    @property
    def landing_target(self) -> LandingTarget | None:
        """Vehicle, autopilot and frames of the request to land that a failure now would cause; None if it would not."""
        is_flown = self._vehicle is not None and self._vehicle.armed
        return self._landing_request.target if is_flown and self._would_land_on_failure else None

    @property
    def _would_land_on_failure(self) -> bool:
        return self._hand_over.lands_on_request and (self._lands_on_failure or self._hand_over.is_ordered_flight)

    def send_landing_request(self, at_ns: int, send: Send) -> bool:
        """Send the landing request of a flight whose cycles fail, if it is due; return whether it is pending."""
        self._begin_landing_request(at_ns)
        if self._landing_request.is_due(at_ns):
            text = "every cycle of the control loop fails: landing is requested"
            self.handle_failure(InternalError(at_ns=at_ns, text=text, effect=InternalErrorEffect.LANDING), send)
        return self._landing_request.is_pending

    def handle_failure(self, failure: InternalError, send: Send) -> Event:
        """Handle an error outside the loop; return its event."""
        self._put("/uavctl/failure", failure.at_ns, failure)
        if failure.effect is InternalErrorEffect.CONTROL:
            return self._fail(failure.text, failure.at_ns)
        event = self._make_error_event(failure.text, failure.at_ns)
        if failure.effect is InternalErrorEffect.LANDING:
            self._send_landing_request(failure.at_ns, send)
        return event

    def _fail_core(self, text: str, at_ns: int) -> Event:
        """Record an error of the core, which need not come again in a replay: no memory, or no end of a tick."""
        self._put("/uavctl/failure", at_ns, InternalError(at_ns=at_ns, text=text, effect=InternalErrorEffect.TICK))
        return self._fail(text, at_ns)

    def _fail(self, text: str, at_ns: int) -> Event:
        self._is_landing_due = self._lands_on_failure or self._hand_over.is_ordered_flight
        self.account.control_error = self.account.control_error or text
        event = Event(
            at_ns=at_ns,
            severity=Severity.ERROR,
            code=EventCode.CONTROL_FAILED,
            text=f"{CONTROL_FAILED_TEXT} {self.account.control_error}",
        )
        self._put("/uavctl/event", at_ns, event)
        return event

    def _make_error_event(self, text: str, at_ns: int) -> Event:
        event = Event(at_ns=at_ns, severity=Severity.ERROR, code=EventCode.INTERNAL_ERROR, text=text)
        self._put("/uavctl/event", at_ns, event)
        return event

    def _begin_landing_request(self, at_ns: int) -> None:
        if self._would_land_on_failure:
            self._landing_request.begin(at_ns)

    def _send_landing_request(self, at_ns: int, send: Send) -> None:
        self._begin_landing_request(at_ns)
        for data in self._landing_request.due(at_ns):
            send(self._record_outgoing(VEHICLE, data, at_ns))

    def receive_landing_answer(self, data: bytes) -> None:
        """Look for the answer to the landing request in a datagram of the vehicle's link."""
        self._landing_request.receive(data)

    def order(self, command: Command) -> bool:
        """Queue an order of the operator for the next tick; False if too many wait already."""
        if not self._inbox.add_order(command):
            return False
        self.account.takes_off = self.account.takes_off or command.order is Order.TAKE_OFF
        return True

    def put_cell(self, cell: CellMessage) -> str:
        """Put a moving cell for the next tick; return why it is refused, empty if it is not."""
        if self._controller.cell_rows is None:
            return "this flight has no moving cells: mission.cells is false"
        try:
            parse_cell(cell)
        except ValueError as error:
            return str(error)
        self._inbox.put_cell(cell)
        return ""

    @property
    def cell_choice(self) -> CellChoice:
        """Cell in use, and the newest one decided."""
        return self._state.cells.choice

    def report_cell(self) -> CellReport | None:
        """Report to the coordinator of the cells how the vehicle moves; None before its position is known."""
        if self._decision is None or self._estimate is None or self._controller.cell_rows is None:
            return None
        conduct = self._find_conduct()
        height_m = self._hand_over.height_m if self._hand_over.is_ordered_flight else 0.0
        return make_report(
            self._state,
            self._controller,
            self._estimate,
            self._decision,
            self.handover_state,
            conduct,
            height_m,
            has_landed=has_landed(self.handover_state, self._vehicle),
        )

    @property
    def cell_status(self) -> tuple[int, Conduct] | None:
        """Number of the moving cell in use (0 without one), and the vehicle's conduct; None in a flight without any."""
        if self._controller.cell_rows is None:
            return None
        cell = self._state.cells.choice.cell
        return NO_CELL if cell is None else cell.number, self._find_conduct()

    def _find_conduct(self) -> Conduct:
        speed_mps = math.hypot(*read_velocity(self._estimate, self._controller.plant))
        return find_conduct(self.handover_state, self._vehicle, self._state, speed_mps)

    @property
    def outside(self) -> str:
        """Name of the controller of another package that plans; empty where one of ours does."""
        return self._controller.outside

    def note_solve_time(self, took_ns: int) -> None:
        """Note the time that a controller of another package took for its last plan; the next tick judges it."""
        self._external_solve_ns = took_ns

    def explain_refusal(self, order: Order) -> str:
        """Return why an order to move or take off would have no effect now; empty if it may be taken."""
        if order is Order.TAKE_OFF:
            is_ordered = self._hand_over.is_ordered_flight
            return explain_take_off_refusal(self.handover_state, self._vehicle, is_ordered_flight=is_ordered)
        is_move = order in (Order.GOTO, Order.HOLD, Order.RESUME)
        return explain_move_refusal(self.handover_state, self._vehicle) if is_move else ""

    def record_timing(self, ticked: Ticked, lateness_ns: int, send_ns: int) -> None:
        """Record the times that the shell measured around a tick."""
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

    def gather_inputs(self, tick: int, at_ns: int, missed_ticks: int, stop: bool) -> StepInput:
        """Take what has come for the tick of `at_ns`; return its inputs, for `run_inputs`."""
        arrivals = self._inbox.take(at_ns)
        self._vehicle_messages, self._statuses = arrivals.messages, arrivals.statuses
        self._motion = self._motion if arrivals.motion is None else arrivals.motion
        self._update_vehicle(arrivals.statuses)
        inputs = StepInput(
            tick=tick,
            at_ns=at_ns,
            samples=arrivals.samples,
            vehicle=self._hand_over.select_controlled_status(at_ns, self._vehicle),
            motion=self._motion,
            inertial=arrivals.inertial,
            missed_ticks=missed_ticks,
            stop=stop,
            commands=arrivals.orders,
            answered_ns=self._external_solve_ns,
            cell=arrivals.cell,
        )
        self._external_solve_ns = 0
        return inputs

    def _update_vehicle(self, statuses: Sequence[VehicleStatus]) -> None:
        """Take the vehicle's new statuses. A later one does not hide that it has left the external mode."""
        flown = self._hand_over.state is HandoverState.ENGAGED
        left_statuses = [status for status in statuses if flown and self._hand_over.has_left_external_mode(status)]
        # The newest status with the mode that it left for counts: it may have the reason of the change.
        left_statuses = [status for status in left_statuses if status.mode == left_statuses[0].mode]
        self._vehicle = next(iter((left_statuses or statuses)[::-1]), self._vehicle)
        address = self._links[VEHICLE].vehicle
        if self._vehicle is not None and address is not None:
            self._landing_request.prepare(address, self._vehicle.autopilot)
        if statuses and self._messages_lost_ns is not None and statuses[-1].at_ns > self._messages_lost_ns:
            self._messages_lost_ns = None

    def _record_output(self, output: TickOutput, at_ns: int) -> None:
        if output.estimate is not None:
            self._put("/uavctl/estimate", at_ns, output.estimate)
        if output.link is not None:
            self._put("/uavctl/link_estimate", at_ns, output.link)
        if output.plan is not None:
            self._put("/uavctl/plan", at_ns, output.plan)
        if output.cell is not None:
            self._put("/uavctl/cell", at_ns, output.cell)
        self._put("/uavctl/decision", at_ns, output.decision)
        for event in output.events:
            self._put("/uavctl/event", at_ns, event)

    def _record_handover(self, handover_output: HandoverOutput, at_ns: int) -> Iterator[Event]:
        """Record the hand-over's events; yield those for the console. Refused orders are answered to their sender."""
        if handover_output.transition is not None:
            self.account.add_transition(handover_output.transition, self._vehicle)
        for event in handover_output.events:
            self._put("/uavctl/event", at_ns, event)
            if event.severity is not Severity.INFO and event.code != EventCode.ORDER_REFUSED:
                yield event

    def _send_commands(self, handover_output: HandoverOutput, output: TickOutput, at_ns: int, send: Send) -> None:
        """Send the vehicle a setpoint, a request, or nothing, as the hand-over allows."""
        link = self._links[VEHICLE]
        is_state_known = self._messages_lost_ns is None
        if is_state_known and handover_output.setpoint_mode is not SetpointMode.NOTHING and output.setpoint is not None:
            self._put("/uavctl/setpoint", at_ns, output.setpoint)
            if handover_output.setpoint_mode is SetpointMode.SETPOINTS:
                self._last_setpoint_ns = at_ns
            send(self._record_outgoing(VEHICLE, link.encode_setpoint(output.setpoint), at_ns))
        if is_state_known and handover_output.request is not None:
            data = link.encode_request(handover_output.request, self._hand_over.height_m)
            send(self._record_outgoing(VEHICLE, data, at_ns))
        if self._hand_over.is_ordered_flight and self._hand_over.state in (
            HandoverState.READY,
            HandoverState.MODE,
            HandoverState.ARMING,
        ):
            for data in link.setup_global_origin(at_ns, self._handover_config.origin_deg_m):
                send(self._record_outgoing(VEHICLE, data, at_ns))

    def _match_answers(
        self, commands: tuple[Command, ...], core: tuple[Event, ...], hand_over: tuple[Event, ...]
    ) -> Iterator[tuple[Command, Event]]:
        """Yield each order with its answer; a landing that the hand-over asks for is accepted, too."""
        for command, event in _pair_answers(commands, core, hand_over):
            is_landing_accepted = (
                command.order is Order.LAND
                and event.code == EventCode.ORDER_REFUSED
                and self.handover_state is HandoverState.LANDING
            )
            text = "land: landing is requested"
            yield (
                command,
                replace(event, severity=Severity.INFO, code=EventCode.ORDER_ACCEPTED, text=text)
                if is_landing_accepted
                else event,
            )

    def _make_handover_input(self, inputs: StepInput, output: TickOutput) -> HandoverInput:
        """Return the inputs of the hand-over in this tick."""
        plant, estimate = self._controller.plant, output.estimate
        up_m, up_mps = None, 0.0
        if estimate is not None and "down" in plant.axes:
            down = plant.axes.index("down")
            up_m, up_mps = -estimate.mean[plant.position_index[down]], -estimate.mean[plant.velocity_index[down]]
        arming_refusal = ""
        if output.setpoint is None or estimate is None:
            arming_refusal = "the controller has no estimate of the position"
        elif estimate.age_s > self._handover_config.fresh_s:
            arming_refusal = f"the newest position is {estimate.age_s:.1f} s old"
        return HandoverInput(
            at_ns=inputs.at_ns,
            vehicle=self._vehicle,
            uptime_s=self._links[VEHICLE].vehicle_uptime_s(inputs.at_ns),
            has_setpoint=output.setpoint is not None,
            is_landing_requested=output.land,
            is_stop_requested=inputs.stop,
            may_have_lost_messages=self._messages_lost_ns is not None,
            arming_refusal=arming_refusal,
            climb_hazard=output.unsafe_to_climb,
            estimated_height_m=up_m,
            climb_rate_mps=up_mps,
            has_motion=moves_now(self._motion, inputs.at_ns),
            messages=self._vehicle_messages,
            commands=inputs.commands,
        )

    def _record_outgoing(self, link: str, data: bytes, at_ns: int) -> Outgoing:
        """Record bytes that are about to be sent, and return them with their connection."""
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


def _describe_error(error: BaseException) -> str:
    """Return an error in words, with its place in the code."""
    last = next(reversed(extract_tb(error.__traceback__)), None)
    where = "" if last is None else f" ({last.filename.rpartition('/')[2]}, line {last.lineno})"
    return f"{in_words(error)}{where}"


def _pair_answers(
    commands: tuple[Command, ...], core: Iterable[Event], hand_over: Iterable[Event]
) -> Iterator[tuple[Command, Event]]:
    """Yield each order with the event that answers it; core and hand-over answer their own orders, in sequence."""
    handover_answers, core_answers = (
        iter([event for event in events if event.code in (EventCode.ORDER_ACCEPTED, EventCode.ORDER_REFUSED)])
        for events in (hand_over, core)
    )
    for command in commands:
        answer = next(handover_answers if command.order in HAND_OVER_ORDERS else core_answers, None)
        if answer is not None:
            yield command, answer
