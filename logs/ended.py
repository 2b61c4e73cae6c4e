"""How a recorded flight ended: the daemon's own last word, or what its records tell where there is none."""

from __future__ import annotations

from logs.digits import number
from logs.flight_data import FlightData
from uavctl.data import ControlMode, Ending
from uavctl.ending import Cause, make_ending

_LANDED = frozenset({Cause.FALLBACK, Cause.ORDERED, Cause.MISSION})
_IN_FLIGHT = {
    ControlMode.BRAKE: "the recording ends while the fallback was braking",
    ControlMode.HOLD: "the recording ends while the fallback held zero acceleration",
}


def ending_of(flight: FlightData) -> Ending:
    """How a flight ended; older recordings, torn ones and parts of a flight do not say it themselves."""
    if flight.endings:
        return flight.endings[-1]
    cause = _cause(flight)
    return make_ending(cause, _sentence(flight, cause))


def _cause(flight: FlightData) -> Cause:
    modes = [decision.mode for decision in flight.flown]
    if flight.breach is not None:
        return Cause.LET_GO
    if ControlMode.LAND in modes:  # for one tick; nobody flies after it
        if flight.landing is None:
            return Cause.FALLBACK
        return Cause.ORDERED if flight.landing.ordered else Cause.MISSION
    if not modes or modes[-1] is ControlMode.WAIT:
        return Cause.WAITING
    return Cause.IN_FLIGHT if flight.stopped_ns is None else Cause.OPERATOR


def _sentence(flight: FlightData, cause: Cause) -> str:
    last = (flight.flown or flight.decisions)[-1]
    if flight.breach is not None:
        return f"{cause.value} after {_seconds(flight, flight.breach.at_ns)}: {flight.breach.text}"
    if cause in _LANDED:
        landed_ns = next(d.at_ns for d in flight.flown if d.mode is ControlMode.LAND)
        return f"{cause.value} after {_seconds(flight, landed_ns)}"
    if cause is Cause.WAITING:
        return f"at the end the controller was waiting: {last.reason}"
    if flight.stopped_ns is not None:
        return f"{cause.value} after {_seconds(flight, flight.stopped_ns)}; {_hand_over(flight)}"
    if flight.landing is not None and last.mode in _IN_FLIGHT:
        return "the recording ends while the vehicle was brought to rest, to land"
    return _IN_FLIGHT.get(last.mode, "at the end a plan was being flown")


def _hand_over(flight: FlightData) -> str:
    """What the controller did after the operator's stop."""
    modes = {d.mode for d in flight.decisions[len(flight.flown) :]}
    if ControlMode.LAND in modes:
        return "the vehicle was handed over to its own landing"
    if ControlMode.STOPPED in modes:
        return "the vehicle was handed over"
    return "the recording ends before the vehicle was handed over"


def _seconds(flight: FlightData, at_ns: int) -> str:
    return f"{number(float(flight.seconds([at_ns])[0]))} s"
