"""Parameters of the simulated quadrotor: a Crazyflie 2.0, as identified and measured by others.

Sources, named at each figure:

* Förster: J. Förster, System Identification of the Crazyflie 2.0 Nano Quadrocopter, ETH Zurich, 2015.
* Bitcraze: the measured table of current, thrust, voltage, duty and speed of a Crazyflie 2.0 on a thrust stand
  (documentation of the Crazyflie firmware, page "PWM to thrust"). The constants are least squares over its 16 rows;
  `docs/vehicle.md` gives them, and a test repeats the fits.
* Firmware: the table of open-circuit voltages in the Crazyflie firmware's power management.
* Estimate: no published value; the reasoning is in `docs/vehicle.md`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
