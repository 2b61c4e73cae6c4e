"""Codes of events, for programs. The text of an event is for people."""

from __future__ import annotations

from enum import StrEnum

MISSION = "mission"  # subject: the mission is over, and the vehicle lands


class EventCode(StrEnum):
    """Code of an event, and cause of a monitor's verdict. In brackets: the event's subject, where it has one."""

    # Answers to orders, one each, in their order
    ORDER_ACCEPTED = "order-accepted"  # [order]
    ORDER_REFUSED = "order-refused"
    # Hand-over of the vehicle
    HAND_OVER = "hand-over"  # a state was entered [state]
    REQUEST_FAILED = "refused"  # the vehicle has not done what it was asked to do
    HEARTBEAT = "heartbeat"  # lost in flight, or back
    # Mode of the controller that was entered [MISSION, or nothing]
    DISENGAGED = "disengaged"
    TRACK = "track"
    BRAKE = "fallback-brake"
    HOLD = "fallback-hold"
    LAND = "fallback-land"
    STOPPED = "stopped"
    # The vehicle is let go: its positions or its motion cannot be right
    OUTSIDE = "envelope-outside"  # the estimate is outside the room
    RESPONSE = "envelope-response"  # positions show an acceleration that nothing explains
    VELOCITY = "envelope-velocity"  # positions move otherwise than the vehicle says
    SCATTER = "envelope-scatter"  # positions scatter more than the vehicle can move
    SETPOINT_RESPONSE = "envelope-setpoint-response"  # the vehicle does not answer setpoints as they say
    BRAKING = "envelope-braking"  # braking has no effect
    # Causes to brake, or to distrust a source; no event of their own
    POSITIONS_ABSURD = "positions-absurd"  # all positions are further out than any can be
    PREDICTION_INCONSISTENT = "prediction-inconsistent"  # the vehicle moves otherwise than was predicted
    SOURCE_MOVED = "positions-moved"  # refused positions agree for so long that their source has moved
    CONTROLLER_LATE = "controller-late"  # a controller of another package takes too long
    CONTROLLER_WALL = "controller-wall"  # it flies too fast towards a limit
    # Samples that the filter refuses
    SAMPLE_DUPLICATE = "sample-duplicate"
    SAMPLE_TOO_OLD = "sample-too-old"
    SAMPLE_INVALID = "sample-invalid"
    SAMPLE_FUTURE = "sample-future"  # captured after it arrived, by its stamp
    SAMPLE_FROZEN = "sample-frozen"  # a source repeats its value although the vehicle moves
    SAMPLE_REPEATED = "sample-repeated"  # a source repeats its value, and it may be frozen
    SAMPLE_JUMP = "sample-jump"  # a position that the vehicle cannot have come to
    POSITIONS_LATE = "positions-late"  # the camera system smooths, or stamps too late; it is counted in
    # Solver
    SOLVE_INFEASIBLE = "solve-infeasible"
    SOLVE_INACCURATE = "solve-inaccurate"
    SOLVE_ITERATION_LIMIT = "solve-iteration_limit"
    SOLVE_LATE = "solve-late"
    SOLVE_FAILED = "solve-failed"
    # Controller
    CONTROL_FAILED = "control"  # an error in the program
    CONTROLLER_FAULT = "controller-fault"  # a controller of another package is given up
    MISSED_TICKS = "missed-ticks"
    RELAXED = "gave-way"  # limits were relaxed in a plan
    POSITION_RESTART = "position-restart"  # the filter starts again at a new place
    # Disturbance
    BIAS_AT_BOUND = "bias-at-bound"
    BIAS_FREE = "bias-free"
    STRONG_PUSH = "strong-push"  # a wind or a hit, not a false position
    # Inertial data
    INERTIAL_DOUBTED = "inertial-doubted"  # they contradict positions, the vehicle's velocity or the model
    INERTIAL_SILENT = "inertial-silent"
    INERTIAL_USED = "inertial-used"
    INERTIAL_STALE = "inertial-not-of-now"  # late, repeated, or frozen [connection]
    VELOCITY_STALE = "velocity-not-of-now"  # the vehicle's own, late by its stamp [connection]
    # Link model
    LINK_BURSTS = "link-bursts"
    LINK_BELOW_DESIGN = "link-below-promise"
    RISK_SATURATED = "risk-saturated"  # limits are left more often than allowed, and plans keep as far away as they may
    # Connections [connection]
    HUNG_UP = "hung-up"  # the other side has closed a TCP connection
    CONNECTION_SILENT = "went-silent"  # nothing came over a TCP connection any more
    PROCESS_ENDED = "process-ended"  # the process that listens to cameras has ended
    SEVERAL_PUBLISHERS = "several-publishers"  # another node of ROS 2 publishes positions on the same topic
    CLOCK_RESYNC = "clock-resync"
    STAMP_UNIT = "stamp-unit"
    SLOW_ANSWER = "timesync"  # answers to TIMESYNC were too slow to be used
    NO_HEARTBEAT = "no-heartbeat"
    SECOND_VEHICLE = "second-vehicle"
    VEHICLE_REBOOT = "vehicle-reboot"
    DROPPED = "dropped"
    # Vehicle
    VEHICLE_TEXT = "vehicle-text"
    COMMAND_ACK = "command-ack"  # [command]
    # Relay of positions to the vehicle
    RELAY_SILENT = "relay-silent"
    RELAY_RESUMED = "relay-resumed"
    RELAY_ATTITUDE = "relay-attitude"  # poses have a wrong attitude [what is wrong]
    RELAY_ATTITUDE_RIGHT = "relay-attitude-right"
    # Errors that do not end the flight
    INTERNAL_ERROR = "internal-error"
    # Recorder
    RECORDING = "recording"
