"""Battery: charge, voltage under load, and the rotor speed that the voltage allows."""

from __future__ import annotations

import math

from sim.vehicle.airframe import Airframe


class BatteryModel:
    """Battery: a voltage that sinks with the charge used, behind a resistance, feeding a load of given power.

    Attributes:
        voltage_v: at the terminals, under the last load.
        current_a: current of the last load [A].
        used_c: charge used.
    """

    def __init__(self, airframe: Airframe, *, charge: float = 1.0) -> None:
        self._airframe = airframe
        self._tenths = len(airframe.open_circuit_v) - 1
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
        table, tenths = self._airframe.open_circuit_v, self._tenths
        table_position = self.remaining * tenths
        low = min(int(table_position), tenths - 1)
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
