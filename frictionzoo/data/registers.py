"""Raw registers of servos: integers with a zero, a unit of the maker, and negative values in an unsigned word."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.data.recording import Table
from frictionzoo.data.words import EFFORT, VELOCITY, list_words, split

UNDETECTED = "none"
"""Value of `data.registers` that switches detection off."""
OF_SIGNAL = {
    **{"qpos": "position", "qvel": "velocity", "ctrl_velocity": "velocity", "ctrl_torque": "effort"},
    **{"torque": "effort", "supply": "supply"},
}
"""Kind of the register of each signal; the header of `ctrl` decides."""
SAME_UNIT = 0.01  # relative difference of units that are the same, rounded
SUPPLY = 0.1  # V per unit of the supply register of all these servos


@dataclass(frozen=True)
class Registers:
    """Meaning of a servo's raw registers.

    Attributes:
        turn: Position units per turn.
        zero: Position at which the angle is 0.
        velocity: Velocity unit [rad/s]; None for position units per second.
        signs: Coding of negative values by kind of register, `position`, `velocity` or `effort`: the number of the sign
            bit, the lowest being 0; None for two's complement in words of 16 or 32 bits.
    """

    turn: float
    zero: float = 0.0
    velocity: float | None = None
    signs: Mapping[str, int | None] | None = None

    def units(self, kind: str) -> float:
        """Return SI units per register unit; 1 for an effort, whose unit differs between servos of one series."""
        step = math.tau / self.turn
        velocity = step if self.velocity is None else self.velocity
        return {"position": step, "velocity": velocity, "supply": SUPPLY}.get(kind, 1.0)

    def suits(self, unit: str | None) -> bool:
        """Return whether a stated unit of the position equals the register's unit, or is None."""
        try:
            return unit is None or abs(float(unit) / self.units("position") - 1) < SAME_UNIT
        except ValueError:
            return False

    def decode(self, values: Real[np.ndarray, "rows"], kind: str) -> Float[np.ndarray, "rows"]:
        """Return signed register values counted from the zero; negative values are already signed and stay."""
        values = values.astype(np.float64)
        bit = (self.signs or {}).get(kind)
        if bit is not None:
            is_negative = (values >= 2**bit) & (values < 2 ** (bit + 1))
            values = np.where(is_negative, 2**bit - values, values)
        else:
            # A position may count many turns: only in 32 bits is its upper half certainly negative.
            for bits in (32,) if kind == "position" else (32, 16):
                is_negative = (values >= 2 ** (bits - 1)) & (values < 2**bits)
                values = np.where(is_negative, values - 2**bits, values)
        return values - self.zero if kind == "position" else values


SERIES: Mapping[str, Registers] = {
    # Source: ROBOTIS e-Manual, control table of XM430-W210 and others: 0.088 deg/pulse, 0 to 4095 with the centre at
    # 2048, 0.229 rev/min; negative numbers are two's complement in 4 bytes, currents and PWM in 2.
    "dynamixel_x": Registers(4096.0, 2048.0, 0.229 * math.tau / 60),
    # Source: Feetech, memory table of SMS/STS: 4096 steps per turn, speed in steps/s (50 steps/s = 0.732 rpm); sign in
    # bit 15, of load and PWM in bit 10 (SMS_STS.cpp of Feetech's SCServo library).
    "feetech_sts": Registers(4096.0, 2048.0, None, {"position": 15, "velocity": 15, "effort": 10}),
    # Source: Feetech, SCS0009: 0 to 1023 over 300 degrees; SCSCL.cpp of its library: speed in steps/s, sign in bit 15,
    # of the load in bit 10.
    "feetech_scs": Registers(1024 * 360 / 300, 512.0, None, {"velocity": 15, "effort": 10}),
}
"""Registers of servo series by name."""


def read_registers(given: Any) -> Registers | str | None:
    """Return the option `data.registers` as registers; `UNDETECTED` and None stay.

    Raises:
        ConfigError: The series is unknown, or a value is impossible.
    """
    if given is None or given == UNDETECTED or isinstance(given, Registers):
        return given
    if isinstance(given, Mapping):
        return _read_custom(given)
    if given not in SERIES:
        raise ConfigError(f"data.registers={given}: unknown; {closest(str(given), (*SERIES, UNDETECTED))}")
    return SERIES[given]


def _read_custom(given: Mapping[str, Any]) -> Registers:
    numbers = {"turn": "ticks per turn, a positive number", "zero": "a number of ticks", "velocity": "rad/s per unit"}
    for name in given:
        if name not in (*numbers, "signs"):
            raise ConfigError(f"data.registers.{name}: unknown; {closest(str(name), (*numbers, 'signs'))}")
    for name, expected in numbers.items():
        value = given.get(name, None if name == "turn" else 1.0)
        is_number = isinstance(value, int | float) and math.isfinite(value) and (name == "zero" or value > 0)
        if not is_number and not (name == "velocity" and value is None):
            raise ConfigError(f"data.registers.{name}={value}: expected {expected}, as in {{turn: 4096, zero: 2048}}")
    signs = given.get("signs") or {}
    for kind, bit in signs.items() if isinstance(signs, Mapping) else [(signs, signs)]:
        if kind not in ("position", "velocity", "effort") or not (bit is None or bit in range(1, 32)):
            raise ConfigError(
                f"data.registers.signs.{kind}={bit}: expected the number of the sign bit, 1 to 31, or null for two's "
                "complement, as in {velocity: 15}"
            )
    return Registers(**{name: float(value) for name, value in given.items() if name in numbers and value}, signs=signs)


def find_kind(signal: str, header: str) -> str | None:
    """Return the kind of the register in a signal's column; None for one without a register, such as time."""
    words = {*list_words(split(header))}
    if signal == "ctrl" and words & {*VELOCITY.split()}:
        return "velocity"
    if signal == "ctrl" and words & {*EFFORT.split()}:
        return "effort"
    return "position" if signal == "ctrl" else OF_SIGNAL.get(signal)


def decode_table(table: Table, columns: Mapping[str, Sequence[str]], registers: Registers) -> Table:
    """Return a table with the registers of these signals as signed numbers, and their units."""
    values, units = dict(table.columns), dict(table.units)
    for signal, headers in columns.items():
        for header in headers:
            kind = find_kind(signal, header)
            if kind is not None and header in table.columns:
                values[header] = registers.decode(table.columns[header], kind)
                units[header] = repr(registers.units(kind))
    return replace(table, columns=values, units=units)
