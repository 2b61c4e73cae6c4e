"""A hand-over in virtual time, and a vehicle whose reports the test sets."""

from __future__ import annotations

from msgspec.structs import replace

from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.handover import HandoverOutput, HandoverStateMachine
from uavctl.mavlink.handover_guards import HandoverInput
from uavctl.mavlink.handover_states import HandoverState, SetpointMode
from uavctl.mavlink.messages import CommandAck, StatusText
from uavctl.mavlink.requests import COMMANDS, RequestKind
from uavctl.records import Command, Event, Order, VehicleStatus

SECOND, TICK_NS = 1_000_000_000, 50_000_000
NOW = 100 * SECOND
ACCEPTED, REJECTED, DENIED, FAILED, IN_PROGRESS = 0, 1, 2, 4, 5
TAKE_OFF, ENGAGE, LAND, STAND_BY = (
    Command(order=Order.TAKE_OFF, height_m=2.0),
    Command(order=Order.ENGAGE),
    Command(order=Order.LAND),
    Command(order=Order.STAND_BY),
)
NOTHING, NEUTRAL, FLY = SetpointMode.NOTHING, SetpointMode.NEUTRAL, SetpointMode.SETPOINTS


class HandoverRig:
    """Hand-over, and a vehicle whose reports the test sets; it sends its status every tick unless it is mute."""

    def __init__(self, autopilot: str = "px4", config: HandOverConfig | None = None) -> None:
        self.hand_over = HandoverStateMachine(config)
        ground = "AUTO.LOITER" if autopilot == "px4" else "STABILIZE"
        self.vehicle: VehicleStatus | None = VehicleStatus(
            at_ns=NOW, autopilot=autopilot, armed=False, mode=ground, external=False, landed=True, radio=True
        )
        self.mute = False
        self.view = HandoverInput(at_ns=NOW, vehicle=None, has_setpoint=True, estimated_height_m=0.0)
        self.asked: list[tuple[int, RequestKind]] = []
        self.events: list[Event] = []

    @property
    def state(self) -> HandoverState:
        return self.hand_over.state

    def report_status(self, **fields: object) -> None:
        """Change the status that the vehicle reports."""
        assert self.vehicle is not None
        mode = fields.get("mode", self.vehicle.mode)
        external = mode in ("OFFBOARD", "GUIDED")
        self.vehicle = replace(self.vehicle, **{"external": external, **fields})

    def is_in(self, *states: HandoverState) -> bool:
        return self.state in states

    def last_request(self, ask: RequestKind) -> bool:
        return self.asked[-1][1] is ask

    def tick(
        self, *received: CommandAck | StatusText, commands: tuple[Command, ...] = (), **fields: object
    ) -> HandoverOutput:
        at_ns = self.view.at_ns + TICK_NS
        if self.vehicle is not None and not self.mute:
            self.vehicle = replace(self.vehicle, at_ns=at_ns)
        self.view = replace(
            self.view, at_ns=at_ns, vehicle=self.vehicle, messages=received, commands=commands, **fields
        )
        requests = self.hand_over.update(self.view)
        if requests.request is not None:
            self.asked.append((at_ns, requests.request))
        self.events += requests.events
        return requests

    def run(self, seconds: float, *, until: HandoverState | None = None) -> None:
        for _ in range(round(seconds * SECOND) // TICK_NS):
            if self.state is until:
                return
            self.tick()
        assert until is None or self.state is until

    def answer(self, result: int, ask: RequestKind | None = None, text: str = "") -> HandoverOutput:
        """The vehicle answers the last request, or this one."""
        arguments = (StatusText(system=1, component=1, severity=2, text=text),) if text else ()
        return self.tick(ack(result, ask or self.asked[-1][1]), *arguments)

    def advance_to(self, state: HandoverState) -> HandoverRig:
        """Go on the usual way as far as a state, with a vehicle that does what it is asked for."""
        px4 = self.vehicle is not None and self.vehicle.autopilot == "px4"
        if state is HandoverState.WAITING:
            return self
        self.tick()
        if state is HandoverState.READY:
            return self
        if (
            state
            in (
                HandoverState.ENGAGED,
                HandoverState.TAKEN_OVER,
                HandoverState.RETURNING,
                HandoverState.LANDING,
                HandoverState.SETTLING,
            )
            and not self.view.commands
        ):
            self.report_status(armed=True, landed=False, mode="OFFBOARD" if px4 else "GUIDED")
            self.tick()
            return self._beyond(state)
        self.tick(commands=(TAKE_OFF,))
        if state is HandoverState.MODE:
            return self
        self.report_status(mode="AUTO.TAKEOFF" if px4 else "GUIDED")
        self.tick()
        if state is HandoverState.ARMING:
            return self
        self.report_status(armed=True)
        self.tick()
        if state is HandoverState.CLIMBING:
            return self
        if state is HandoverState.FAILSAFE:
            self.fail()
            return self
        if state is HandoverState.UNCLEAR:
            self.report_status(mode="AUTO.RTL" if px4 else "RTL")
            self.tick()
            return self
        self.tick(estimated_height_m=1.9)
        return self

    def fail(self, mode: str = "") -> HandoverOutput:
        """A failsafe of the vehicle's own lands it, or chooses this mode."""
        px4 = self.vehicle is not None and self.vehicle.autopilot == "px4"
        self.report_status(mode=mode or ("AUTO.LAND" if px4 else "LAND"), failsafe=True)
        return self.tick()

    def _beyond(self, state: HandoverState) -> HandoverRig:
        if state in (HandoverState.TAKEN_OVER, HandoverState.RETURNING):
            self.report_status(mode="POSCTL")
            self.tick()
        if state is HandoverState.RETURNING:
            self.tick(commands=(ENGAGE,))
        if state in (HandoverState.LANDING, HandoverState.SETTLING):
            self.tick(is_landing_requested=True)
            self.view = replace(self.view, is_landing_requested=False)
        if state is HandoverState.SETTLING:
            self.report_status(mode="AUTO.LAND")
            self.tick()
        return self

    def codes(self, code: str) -> list[str]:
        return [event.text for event in self.events if event.code == code]


def ack(result: int, ask: RequestKind) -> CommandAck:
    return CommandAck(
        system=1, component=1, command=COMMANDS[ask], result=result, target_system=245, target_component=25
    )
