"""A hand-over in virtual time, and a vehicle whose words are put into its mouth."""

from __future__ import annotations

from msgspec.structs import replace

from uavctl.config.hand_over import HandOverConfig
from uavctl.data import Command, Event, Order, VehicleStatus
from uavctl.mavlink.hand_over import HandOver, Told
from uavctl.mavlink.messages import Ack, Text
from uavctl.mavlink.mode import Sending, State
from uavctl.mavlink.request import COMMANDS, Ask
from uavctl.mavlink.sight import View

SECOND, TICK_NS = 1_000_000_000, 50_000_000
NOW = 100 * SECOND
ACCEPTED, REJECTED, DENIED, FAILED, IN_PROGRESS = 0, 1, 2, 4, 5
TAKE_OFF, ENGAGE, LAND, STAND_BY = (
    Command(order=Order.TAKE_OFF, height_m=2.0),
    Command(order=Order.ENGAGE),
    Command(order=Order.LAND),
    Command(order=Order.STAND_BY),
)
NOTHING, NEUTRAL, FLY = Sending.NOTHING, Sending.NEUTRAL, Sending.SETPOINTS


class Rig:
    """A hand-over and a vehicle whose words are put into its mouth; it says every tick who it is, unless it is mute."""

    def __init__(self, autopilot: str = "px4", config: HandOverConfig | None = None) -> None:
        self.hand_over = HandOver(config)
        ground = "AUTO.LOITER" if autopilot == "px4" else "STABILIZE"
        self.vehicle: VehicleStatus | None = VehicleStatus(
            at_ns=NOW, autopilot=autopilot, armed=False, mode=ground, external=False, landed=True
        )
        self.mute = False
        self.view = View(at_ns=NOW, vehicle=None, ready=True, up_m=0.0)
        self.asked: list[tuple[int, Ask]] = []
        self.events: list[Event] = []

    @property
    def state(self) -> State:
        return self.hand_over.state

    def be(self, **fields: object) -> None:
        """Change what the vehicle says of itself."""
        assert self.vehicle is not None
        mode = fields.get("mode", self.vehicle.mode)
        external = mode in ("OFFBOARD", "GUIDED")
        self.vehicle = replace(self.vehicle, **{"external": external, **fields})

    def is_in(self, *states: State) -> bool:
        return self.state in states

    def asked_last(self, ask: Ask) -> bool:
        return self.asked[-1][1] is ask

    def tick(self, *heard: Ack | Text, commands: tuple[Command, ...] = (), **fields: object) -> Told:
        at_ns = self.view.at_ns + TICK_NS
        if self.vehicle is not None and not self.mute:
            self.vehicle = replace(self.vehicle, at_ns=at_ns)
        self.view = replace(self.view, at_ns=at_ns, vehicle=self.vehicle, heard=heard, commands=commands, **fields)
        told = self.hand_over.update(self.view)
        if told.ask is not None:
            self.asked.append((at_ns, told.ask))
        self.events += told.events
        return told

    def run(self, seconds: float, *, until: State | None = None) -> None:
        for _ in range(round(seconds * SECOND) // TICK_NS):
            if self.state is until:
                return
            self.tick()
        assert until is None or self.state is until

    def answer(self, result: int, ask: Ask | None = None, text: str = "") -> Told:
        """The vehicle answers the last request, or this one."""
        words = (Text(system=1, component=1, severity=2, text=text),) if text else ()
        return self.tick(ack(result, ask or self.asked[-1][1]), *words)

    def to(self, state: State) -> Rig:
        """Go on the usual way as far as a state, with a vehicle that does what it is asked for."""
        px4 = self.vehicle is not None and self.vehicle.autopilot == "px4"
        if state is State.WAITING:
            return self
        self.tick()
        if state is State.READY:
            return self
        if (
            state in (State.ENGAGED, State.RELEASED, State.RETURNING, State.LANDING, State.SETTLING)
            and not self.view.commands
        ):
            self.be(armed=True, landed=False, mode="OFFBOARD" if px4 else "GUIDED")
            self.tick()
            return self._beyond(state)
        self.tick(commands=(TAKE_OFF,))
        if state is State.MODE:
            return self
        self.be(mode="AUTO.TAKEOFF" if px4 else "GUIDED")
        self.tick()
        if state is State.ARMING:
            return self
        self.be(armed=True)
        self.tick()
        if state is State.CLIMBING:
            return self
        if state is State.FAILSAFE:
            self.fail()
            return self
        self.tick(up_m=1.9)
        return self

    def fail(self, mode: str = "") -> Told:
        """A failsafe of the vehicle's own lands it, or chooses this mode."""
        px4 = self.vehicle is not None and self.vehicle.autopilot == "px4"
        self.be(mode=mode or ("AUTO.LAND" if px4 else "LAND"), failsafe=True)
        return self.tick()

    def _beyond(self, state: State) -> Rig:
        if state in (State.RELEASED, State.RETURNING):
            self.be(mode="POSCTL")
            self.tick()
        if state is State.RETURNING:
            self.tick(commands=(ENGAGE,))
        if state in (State.LANDING, State.SETTLING):
            self.tick(land=True)
            self.view = replace(self.view, land=False)
        if state is State.SETTLING:
            self.be(mode="AUTO.LAND")
            self.tick()
        return self

    def codes(self, code: str) -> list[str]:
        return [event.text for event in self.events if event.code == code]


def ack(result: int, ask: Ask) -> Ack:
    return Ack(system=1, component=1, command=COMMANDS[ask], result=result, target_system=245, target_component=25)
