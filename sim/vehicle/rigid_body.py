"""Motion of a rigid body with thrust, rotor drag and body drag; attitude as quaternion, axes NED and FRD.

Plain floats: at this size they are several times faster than small arrays, and the same bits everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from uavctl.records import Vec3

# Parameters of the simulated quadrotor: a Crazyflie 2.0, as identified and measured by others.
#
# Sources, named at each figure:
#
# * Förster: J. Förster, System Identification of the Crazyflie 2.0 Nano Quadrocopter, ETH Zurich, 2015.
# * Bitcraze: the measured table of current, thrust, voltage, duty and speed of a Crazyflie 2.0 on a thrust stand
#   (documentation of the Crazyflie firmware, page "PWM to thrust"). The constants are least squares over its 16 rows;
#   `docs/vehicle.md` gives them, and a test repeats the fits.
# * Firmware: the table of open-circuit voltages in the Crazyflie firmware's power management.
# * Estimate: nobody has published it; the reasoning is in `docs/vehicle.md`.


GRAVITY_MPS2 = 9.80665
AIR_DENSITY_KGPM3 = 1.225


@dataclass(frozen=True)
class Airframe:
    """A quadrotor with rotors at 45 degrees to its axes; body axes FRD (front, right, down)."""

    mass_kg: float  # mass
    inertia_kgm2: tuple[float, float, float]  # principal moments of inertia about front, right, down
    arm_m: float  # distance of each rotor from the centre of mass
    thrust_n_s2: float  # k_T of thrust = k_T Ω², one rotor [N s²]
    torque_m: float  # reaction torque per thrust, k_Q / k_T [m]
    motor_lag_s: float  # time constant of the rotors' speed
    idle_rps: float  # slowest speed of an armed rotor [rad/s]
    speed_at_0v_rps: float  # intercept of the largest speed as a line over the battery's voltage [rad/s]
    speed_per_v_rps: float  # slope of that line [rad/s per V]
    # drag of the rotors along front, right, down per air speed and per sum of rotor speeds [kg]
    rotor_drag_kg: tuple[float, float, float]
    drag_area_m2: tuple[float, float, float]  # C_d A of the body along front, right, down
    electronics_w: float  # power without thrust
    power_per_thrust_wpn: float  # power per newton of thrust
    capacity_c: float  # charge of the full battery [C]
    resistance_ohm: float  # battery, protection and wires
    open_circuit_v: tuple[float, ...]  # voltage without load at charges 0, 0.1, ..., 1.0
    friction: float  # of the floor

    @property
    def weight_n(self) -> float:
        """Weight [N]."""
        return self.mass_kg * GRAVITY_MPS2

    @property
    def hover_rps(self) -> float:
        """Rotor speed at which four rotors carry the weight [rad/s]."""
        return math.sqrt(self.weight_n / (4.0 * self.thrust_n_s2))


CRAZYFLIE_2 = Airframe(
    mass_kg=0.028,  # Förster
    inertia_kgm2=(16.571710e-6, 16.655602e-6, 29.261652e-6),  # Förster; products of inertia, up to 1.8e-6, left out
    arm_m=0.046,  # Bitcraze: 92 mm from motor to motor
    thrust_n_s2=2.2176e-8,  # Bitcraze, fitted to speed and thrust
    torque_m=0.005964552,  # Förster
    motor_lag_s=0.0647,  # Förster: pole of the motors' transfer function at -15.4666 1/s
    idle_rps=469.7,  # Bitcraze: 4485 1/min at the lowest duty of the table
    speed_at_0v_rps=531.5,  # Bitcraze, fitted to duty times voltage and speed from 25 % duty
    speed_per_v_rps=616.0,  # the same
    rotor_drag_kg=(9.1785e-7, 9.1785e-7, 10.311e-7),  # Förster
    drag_area_m2=(1.0e-3, 1.0e-3, 2.5e-3),  # Estimate
    electronics_w=1.071,  # Bitcraze, fitted to power and thrust
    power_per_thrust_wpn=23.97,  # the same
    capacity_c=864.0,  # Bitcraze: 240 mAh
    resistance_ohm=0.15,  # Estimate
    open_circuit_v=(3.00, 3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.00, 4.04, 4.10, 4.20),  # Firmware; full: charger
    friction=0.5,  # Estimate
)


# The battery: charge, voltage under load, and the rotor speed that the voltage allows.


class BatteryModel:
    """Battery: a voltage that sinks with the charge used, behind a resistance, feeding a load of given power.

    Attributes:
        voltage_v: at the terminals, under the last load.
        current_a: current of the last load [A].
        used_c: charge used.
    """

    def __init__(self, airframe: Airframe, *, charge: float = 1.0) -> None:
        self._airframe = airframe
        self.set_charge(charge)
        self.current_a = 0.0
        self.voltage_v = self.open_circuit_v

    def set_charge(self, charge: float) -> None:
        """Set the charge, 0 to 1."""
        self.used_c = (1.0 - charge) * self._airframe.capacity_c

    @property
    def remaining(self) -> float:
        """Charge left, 0 to 1."""
        return max(1.0 - self.used_c / self._airframe.capacity_c, 0.0)

    @property
    def is_empty(self) -> bool:
        """Whether no charge is left: the battery's protection has switched off."""
        return self.used_c >= self._airframe.capacity_c

    @property
    def open_circuit_v(self) -> float:
        """Voltage without load [V], linear between the tenths of the table."""
        table = self._airframe.open_circuit_v
        table_position = self.remaining * (len(table) - 1)
        low = min(int(table_position), len(table) - 2)
        return table[low] + (table_position - low) * (table[low + 1] - table[low])

    @property
    def max_rps(self) -> float:
        """Largest rotor speed at the present voltage [rad/s]."""
        return self._airframe.speed_at_0v_rps + self._airframe.speed_per_v_rps * self.voltage_v

    def drain(self, thrust_n: float, duration_s: float) -> None:
        """Feed the electronics and the rotors' thrust for a time.

        U² - E U + R P = 0 has the voltage U under the power P; beyond E²/4R the battery gives no more, and nothing
        once it is empty.
        """
        if self.is_empty:
            self.voltage_v = self.current_a = 0.0
            return
        power_w = self._airframe.electronics_w + self._airframe.power_per_thrust_wpn * thrust_n
        source_v = self.open_circuit_v
        discriminant = source_v * source_v - 4.0 * self._airframe.resistance_ohm * power_w
        self.voltage_v = 0.5 * (source_v + math.sqrt(max(discriminant, 0.0)))
        self.current_a = (source_v - self.voltage_v) / self._airframe.resistance_ohm
        self.used_c += self.current_a * duration_s


Quaternion = tuple[float, float, float, float]  # w, x, y, z: turns body axes into NED

LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Wrench(NamedTuple):
    """Force and torque of the rotors on the body."""

    thrust_n: float  # along -down of the body
    torque_nm: Vec3  # about front, right, down
    speeds_rps: float  # sum of the rotors' speeds; rotor drag is proportional to it


class BodyState(NamedTuple):
    """State of the body: position and velocity in NED, attitude, rates about body axes."""

    position_m: Vec3
    velocity_mps: Vec3
    attitude: Quaternion
    rates_rps: Vec3


@dataclass(frozen=True)
class Body:
    """Constants of a body in the form that the equations of motion need."""

    mass_kg: float
    inertia_kgm2: Vec3
    rotor_drag_kg: Vec3
    body_drag_kgpm: Vec3  # ½ ρ C_d A

    @classmethod
    def from_airframe(cls, airframe: Airframe) -> Body:
        """Return the body of an airframe."""
        front, right, down = (0.5 * AIR_DENSITY_KGPM3 * area for area in airframe.drag_area_m2)
        return cls(airframe.mass_kg, airframe.inertia_kgm2, airframe.rotor_drag_kg, (front, right, down))


def rotate_attitude(attitude: Quaternion, angle: Vec3) -> Quaternion:
    """Return the attitude turned further by a rotation vector [rad] in body axes; of unit norm."""
    w, x, y, z = attitude
    p, q, r = angle
    square = p * p + q * q + r * r
    norm = math.sqrt(square)
    c = math.cos(0.5 * norm)
    s = math.sin(0.5 * norm) / norm if norm > 1e-6 else 0.5 - square / 48.0
    p, q, r = s * p, s * q, s * r
    w, x, y, z = (
        w * c - x * p - y * q - z * r,
        w * p + x * c + y * r - z * q,
        w * q - x * r + y * c + z * p,
        w * r + x * q - y * p + z * c,
    )
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)  # takes away rounding only
    return w * scale, x * scale, y * scale, z * scale


def reduce_tilt(attitude: Quaternion, factor: float) -> Quaternion:
    """Return the attitude with the tangent of half its tilt shrunk to the share `keep`; the heading stays."""
    w, x, y, z = attitude
    heading = math.sqrt(w * w + z * z)
    c, s = (w / heading, z / heading) if heading > 0.0 else (1.0, 0.0)
    # attitude = (heading, tx, ty, 0) ⊗ (c, 0, 0, s)
    tx, ty = factor * (x * c - y * s), factor * (y * c + x * s)
    norm = math.sqrt(heading * heading + tx * tx + ty * ty)
    heading, tx, ty = heading / norm, tx / norm, ty / norm
    return heading * c, tx * c + ty * s, ty * c - tx * s, heading * s


def compute_acceleration(body: Body, attitude: Quaternion, velocity: Vec3, wrench: Wrench, wind: Vec3) -> Vec3:
    """Return the acceleration of the centre of mass in NED [m/s²], with gravity.

    Drag in body axes, of the velocity v relative to the air: -(d ΣΩ + ½ ρ C_d A |v|) v, each axis with its own
    coefficients.
    """
    w, x, y, z = attitude
    r11, r12, r13 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r21, r22, r23 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r31, r32, r33 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    north, east, down = velocity[0] - wind[0], velocity[1] - wind[1], velocity[2] - wind[2]
    u = r11 * north + r21 * east + r31 * down
    v = r12 * north + r22 * east + r32 * down
    s = r13 * north + r23 * east + r33 * down
    speed = math.sqrt(north * north + east * east + down * down)
    k, c, total = body.rotor_drag_kg, body.body_drag_kgpm, wrench.speeds_rps
    scale = -1.0 / body.mass_kg
    fx = scale * (k[0] * total + c[0] * speed) * u
    fy = scale * (k[1] * total + c[1] * speed) * v
    fz = scale * ((k[2] * total + c[2] * speed) * s + wrench.thrust_n)
    return (
        r11 * fx + r12 * fy + r13 * fz,
        r21 * fx + r22 * fy + r23 * fz,
        r31 * fx + r32 * fy + r33 * fz + GRAVITY_MPS2,
    )


def _compute_angular_accel(body: Body, rates: Vec3, torque: Vec3) -> Vec3:
    """Return angular accelerations by Euler's equations: J ω' = τ - ω x J ω."""
    jx, jy, jz = body.inertia_kgm2
    p, q, r = rates
    return (
        (torque[0] - (jz - jy) * q * r) / jx,
        (torque[1] - (jx - jz) * r * p) / jy,
        (torque[2] - (jy - jx) * p * q) / jz,
    )


def _compute_rotation_vector_rate(angle: Vec3, rates: Vec3) -> Vec3:
    """Return the rate of the rotation vector: θ' = ω + ½ θ x ω + 1/12 θ x (θ x ω), enough for fourth order."""
    a, b, c = angle
    p, q, r = rates
    x, y, z = b * r - c * q, c * p - a * r, a * q - b * p
    return (
        p + 0.5 * x + (b * z - c * y) / 12.0,
        q + 0.5 * y + (c * x - a * z) / 12.0,
        r + 0.5 * z + (a * y - b * x) / 12.0,
    )


def _add_scaled(start: Vec3, slope: Vec3, h: float) -> Vec3:
    return start[0] + h * slope[0], start[1] + h * slope[1], start[2] + h * slope[2]


def _average_slopes(a: Vec3, b: Vec3, c: Vec3, d: Vec3) -> Vec3:
    """Return the mean slope by the weights of the classical Runge-Kutta method (Simpson's rule)."""
    return (
        (a[0] + 2.0 * (b[0] + c[0]) + d[0]) / 6.0,
        (a[1] + 2.0 * (b[1] + c[1]) + d[1]) / 6.0,
        (a[2] + 2.0 * (b[2] + c[2]) + d[2]) / 6.0,
    )


def integrate_step(
    body: Body, start: BodyState, wrenches: tuple[Wrench, Wrench, Wrench], wind: Vec3, h: float
) -> BodyState:
    """Return the state after one step of Runge and Kutta's fourth-order method, after Munthe-Kaas on the rotations.

    The attitude moves by the exponential of a rotation vector that is integrated like any other variable, so it
    stays a rotation by construction and the order is kept; a method on the four numbers of the quaternion would
    need them pushed back to unit norm in every step, which is an error of the method's own size.

    Args:
        wrenches: wrenches of the rotors at the start, the middle and the end of the step.
        wind: velocity of the air in NED, held over the step [m/s].
        h: length of the step [s].
    """
    first, middle, last = wrenches
    position, v1, attitude, w1 = start
    half = 0.5 * h

    a1 = compute_acceleration(body, attitude, v1, first, wind)
    s1 = _compute_angular_accel(body, w1, first.torque_nm)

    angle = _add_scaled((0.0, 0.0, 0.0), w1, half)
    w2 = _add_scaled(w1, s1, half)
    t2 = _compute_rotation_vector_rate(angle, w2)
    a2 = compute_acceleration(body, rotate_attitude(attitude, angle), _add_scaled(v1, a1, half), middle, wind)
    s2 = _compute_angular_accel(body, w2, middle.torque_nm)

    angle = _add_scaled((0.0, 0.0, 0.0), t2, half)
    w3 = _add_scaled(w1, s2, half)
    t3 = _compute_rotation_vector_rate(angle, w3)
    a3 = compute_acceleration(body, rotate_attitude(attitude, angle), _add_scaled(v1, a2, half), middle, wind)
    s3 = _compute_angular_accel(body, w3, middle.torque_nm)

    angle = _add_scaled((0.0, 0.0, 0.0), t3, h)
    w4 = _add_scaled(w1, s3, h)
    t4 = _compute_rotation_vector_rate(angle, w4)
    a4 = compute_acceleration(body, rotate_attitude(attitude, angle), _add_scaled(v1, a3, h), last, wind)
    s4 = _compute_angular_accel(body, w4, last.torque_nm)

    sixth = h * h / 6.0
    return BodyState(
        (
            position[0] + h * v1[0] + sixth * (a1[0] + a2[0] + a3[0]),
            position[1] + h * v1[1] + sixth * (a1[1] + a2[1] + a3[1]),
            position[2] + h * v1[2] + sixth * (a1[2] + a2[2] + a3[2]),
        ),
        _add_scaled(v1, _average_slopes(a1, a2, a3, a4), h),
        rotate_attitude(attitude, _add_scaled((0.0, 0.0, 0.0), _average_slopes(w1, t2, t3, t4), h)),
        _add_scaled(w1, _average_slopes(s1, s2, s3, s4), h),
    )


# The four rotors: their speeds, what they do to the body, and how a wanted thrust and torque is shared among them.
#
# Order: front right, rear right, rear left, front left. The first and third turn against the clock seen from above, so
# that their reaction torque is to the right (positive about down).


RotorValues = tuple[float, float, float, float]

STOPPED: RotorValues = (0.0, 0.0, 0.0, 0.0)


class Rotors:
    """Rotors with a first-order lag of the speed, thrust k_T Ω² and reaction torque k_Q Ω².

    Attributes:
        speeds_rps: present speeds.
        commands_rps: speeds that they tend to.
        thrust_limited: whether the last command gave more or less thrust than was wanted.
        torque_limited: whether the last command gave more or less torque than was wanted.
    """

    def __init__(self, airframe: Airframe, step_s: float) -> None:
        self._thrust_n_s2 = airframe.thrust_n_s2
        self._lever_m = airframe.arm_m * math.sqrt(0.5)
        self._torque_m = airframe.torque_m
        self._idle_n = airframe.thrust_n_s2 * airframe.idle_rps**2
        self._half_decay = math.exp(-0.5 * step_s / airframe.motor_lag_s)
        self._decay = math.exp(-step_s / airframe.motor_lag_s)
        self.speeds_rps: RotorValues = STOPPED
        self.commands_rps: RotorValues = STOPPED
        self.is_thrust_limited = self.is_torque_limited = False

    def compute_wrench(self, speeds_rps: RotorValues) -> Wrench:
        """Return force and torque of rotors at these speeds."""
        k = self._thrust_n_s2
        a, b, c, d = speeds_rps
        f1, f2, f3, f4 = k * a * a, k * b * b, k * c * c, k * d * d
        return Wrench(
            f1 + f2 + f3 + f4,
            (
                self._lever_m * (f3 + f4 - f1 - f2),
                self._lever_m * (f1 + f4 - f2 - f3),
                self._torque_m * (f1 + f3 - f2 - f4),
            ),
            a + b + c + d,
        )

    def step(self) -> tuple[Wrench, Wrench, Wrench]:
        """Move on by one step, exactly; return the wrenches at its start, middle and end."""
        start = self.speeds_rps
        middle = self._compute_lagged_speeds(self._half_decay)
        self.speeds_rps = self._compute_lagged_speeds(self._decay)
        return self.compute_wrench(start), self.compute_wrench(middle), self.compute_wrench(self.speeds_rps)

    def _compute_lagged_speeds(self, decay: float) -> RotorValues:
        (a, b, c, d), (p, q, r, s) = self.speeds_rps, self.commands_rps
        return p + (a - p) * decay, q + (b - q) * decay, r + (c - r) * decay, s + (d - s) * decay

    def stop(self) -> None:
        """Switch off."""
        self.commands_rps = STOPPED

    def command(self, thrust_n: float, torque_nm: Vec3, max_rps: float) -> None:
        """Command the speeds that give this thrust and torque, as far as the rotors can.

        Where they cannot, roll and pitch come first, then the thrust, then yaw: a vehicle that keeps its
        lean keeps its way.

        Args:
            largest_rps: speed that the battery's voltage allows.
        """
        min_n = self._idle_n
        max_n = max(self._thrust_n_s2 * max_rps * max_rps, min_n)
        roll, pitch = 0.25 * torque_nm[0] / self._lever_m, 0.25 * torque_nm[1] / self._lever_m
        yaw = 0.25 * torque_nm[2] / self._torque_m
        tilt_n = abs(roll) + abs(pitch)
        half = 0.5 * (max_n - min_n)
        is_clipped = tilt_n > half
        if is_clipped:
            roll, pitch, tilt_n = roll * half / tilt_n, pitch * half / tilt_n, half
        mean_n = min(max(0.25 * thrust_n, min_n + tilt_n), max_n - tilt_n)
        yaw_margin_n = min(max_n - tilt_n - mean_n, mean_n - tilt_n - min_n)
        yaw_n = min(max(yaw, -yaw_margin_n), yaw_margin_n)
        self.is_thrust_limited = mean_n != 0.25 * thrust_n
        self.is_torque_limited = is_clipped or yaw_n != yaw
        k = self._thrust_n_s2
        self.commands_rps = (
            math.sqrt(max(mean_n - roll + pitch + yaw_n, 0.0) / k),
            math.sqrt(max(mean_n - roll - pitch - yaw_n, 0.0) / k),
            math.sqrt(max(mean_n + roll - pitch + yaw_n, 0.0) / k),
            math.sqrt(max(mean_n + roll + pitch - yaw_n, 0.0) / k),
        )
