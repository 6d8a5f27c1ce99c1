"""Units as keys end in them, like `margin_us` and `limit_rad_per_s`, and factors between them."""

from __future__ import annotations

import math
import re
from functools import lru_cache

Dimension = frozenset[tuple[str, float]]  # base quantity and its power
Unit = tuple[Dimension, float]  # and the factor to SI

TIME, ANGLE, LENGTH = {"time": 1}, {"angle": 1}, {"length": 1}
FORCE, TORQUE = {"force": 1}, {"force": 1, "length": 1}
VOLTAGE, CURRENT, RESISTANCE = {"voltage": 1}, {"current": 1}, {"voltage": 1, "current": -1}

ATOMS: dict[str, tuple[dict[str, int], float]] = {
    "s": (TIME, 1),
    "ms": (TIME, 1e-3),
    "us": (TIME, 1e-6),
    "ns": (TIME, 1e-9),
    "Hz": ({"time": -1}, 1),
    "kHz": ({"time": -1}, 1e3),
    "MHz": ({"time": -1}, 1e6),
    "rad": (ANGLE, 1),
    "mrad": (ANGLE, 1e-3),
    "deg": (ANGLE, math.pi / 180),
    "turn": (ANGLE, 2 * math.pi),
    "rpm": ({"angle": 1, "time": -1}, 2 * math.pi / 60),
    "m": (LENGTH, 1),
    "cm": (LENGTH, 1e-2),
    "mm": (LENGTH, 1e-3),
    "um": (LENGTH, 1e-6),
    "N": (FORCE, 1),
    "mN": (FORCE, 1e-3),
    "kN": (FORCE, 1e3),
    "Nm": (TORQUE, 1),
    "mNm": (TORQUE, 1e-3),
    "Ncm": (TORQUE, 1e-2),
    "kNm": (TORQUE, 1e3),
    "V": (VOLTAGE, 1),
    "mV": (VOLTAGE, 1e-3),
    "kV": (VOLTAGE, 1e3),
    "A": (CURRENT, 1),
    "mA": (CURRENT, 1e-3),
    "ohm": (RESISTANCE, 1),
    "mohm": (RESISTANCE, 1e-3),
    "kohm": (RESISTANCE, 1e3),
    "counts": ({"counts": 1}, 1),
    "percent": ({}, 1e-2),
    "ppm": ({}, 1e-6),
}
ALIASES = {
    **{name.lower(): name for name in ATOMS if len(name) > 1},
    **{"sec": "s", "seconds": "s", "msec": "ms", "milliseconds": "ms", "usec": "us"},
    **{"microseconds": "us", "hertz": "Hz", "degrees": "deg", "degree": "deg", "radians": "rad"},
    **{"rev": "turn", "turns": "turn", "count": "counts", "volt": "V", "volts": "V", "ohms": "ohm"},
    **{"pct": "percent", "metres": "m", "meters": "m"},
}
WORDS = {"us": "microseconds", "s": "seconds", "turn": "turns"}  # else the unit's symbol is told
LENGTH_MAX = 100  # characters of what can be a number with a unit, or a key with one
PURE: Unit = (frozenset(), 1.0)

_EXPONENT = re.compile(r"(\d)(\d?)(?=_|$)")
_ATOM = re.compile(r"([A-Za-z]+)(\d*)")
_WITH_UNIT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d.].*?)\s*")
_SIGNS = (
    ("µ", "u"),
    ("μ", "u"),
    ("°", "deg"),
    ("%", "percent"),
    ("Ω", "ohm"),
    ("^", ""),
    ("²", "2"),
    ("/", " per "),
)


@lru_cache(4096)
def split(key: str) -> tuple[str, list[Unit]]:
    """A key's stem and its unit, as it may be meant: two for `start_rad_or_m`.

    A key without a unit is a pure number.
    """
    tokens = key.split("_") if len(key) <= LENGTH_MAX else []
    for i in range(len(tokens)):
        if units := _units(tokens[i:]):
            return "_".join(tokens[:i]), units
    return key, [PURE]


def told(key: str) -> str:
    """A key's unit in words, or "" if it has none: `rad/s^2` of `limit_rad_per_s2`."""
    stem, units = split(key)
    if units == [PURE]:
        return ""
    unit = key[len(stem) :].removeprefix("_")
    above, per, below = _EXPONENT.sub(_raised, unit).replace("_", " ").partition(" per ")
    if not per:
        return WORDS.get(unit, above)
    above = f"({above})" if " or " in above else above
    return f"{above}/({below})" if " " in below else f"{above}/{below}"


def factor(given: str, wanted: str) -> float | None:
    """What turns a value of the key `given` into one of `wanted`; None if they do not compare.

    1.0 if neither has a unit.
    """
    return _factor(split(given)[1], split(wanted)[1])


def same_but_unit(given: str, wanted: str) -> bool:
    """Whether two keys differ in nothing but units that can be converted."""
    (stem, units), (other, wanted_units) = split(given), split(wanted)
    known = units != [PURE] or wanted_units != [PURE]
    return known and stem.lower() == other.lower() and _factor(units, wanted_units) is not None


def convert(text: str, wanted: str) -> float | None:
    """What the key `wanted` has for a number with a unit, like `12 ms`; None if it has nothing."""
    found = _WITH_UNIT.fullmatch(text) if len(text) <= LENGTH_MAX else None
    if not found:
        return None
    number, unit = found.groups()
    for sign, word in _SIGNS:
        unit = unit.replace(sign, word)
    scale = _factor(_units([t for t in re.split(r"[\s*·._]+", unit) if t]), split(wanted)[1])
    return None if scale is None else float(number) * scale


def _raised(digits: re.Match[str]) -> str:
    return f"^{digits[1]}.{digits[2]}" if digits[2] else f"^{digits[1]}"


def _factor(given: list[Unit], wanted: list[Unit]) -> float | None:
    for dimension, scale in given:
        for other, unit in wanted:
            if dimension == other:
                return scale / unit
    return None


def _units(tokens: list[str]) -> list[Unit]:
    """The unit that `Nm_s_per_rad` says; empty if it is none."""
    if tokens.count("or") == 1 and "or" in tokens[1:-1]:
        at = tokens.index("or")
        rest = [*tokens[:at], *tokens[at + 2 :]], [*tokens[: at - 1], *tokens[at + 1 :]]
        either = [_units(alternative) for alternative in rest]
        return either[0] + either[1] if all(either) else []
    powers, scale, sign, expected = dict[str, float](), 1.0, 1, True
    for token in tokens:
        if token == "per":
            if expected or sign < 0:
                return []
            sign, expected = -1, True
            continue
        found = _ATOM.fullmatch(token)
        atom = found and (found[1] if found[1] in ATOMS else ALIASES.get(found[1].lower()))
        if not found or not atom:
            return []
        dimension, size = ATOMS[atom]
        digits = found[2] or "1"
        power = sign * (int(digits) if len(digits) == 1 else int(digits) / 10)  # s15 is s^1.5
        for base, exponent in dimension.items():
            powers[base] = powers.get(base, 0) + power * exponent
        scale *= size**power
        expected = False
    if expected:
        return []
    return [(frozenset((base, power) for base, power in powers.items() if power), scale)]
