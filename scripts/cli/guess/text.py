"""A first config as YAML, with the reason beside each value that was guessed."""

from __future__ import annotations

import re
from dataclasses import dataclass

from headway.cli.guess.axes import AxisGuess, Value
from headway.cli.guess.task import Gentle
from headway.cli.guess.weights import Array, Weights
from headway.configs.section import Section

HEAD = """\
# yaml-language-server: $schema={schema}
# {name}: written by `headway init` from {file}.
# A value with "guessed" behind it is not from the model: measure it, or take it from a data sheet.
# docs/your-machine.md says what each of them means, and `headway check` what does not fit together.
"""
COMMENT_COLUMN = 40
BY_AXIS = "by what each axis has to hold and to move"


@dataclass(frozen=True)
class Draft:
    """All that goes into the file."""

    name: str
    model: str  # relative to the file
    schema: str  # likewise: by which editors complete keys
    axes: list[AxisGuess]
    task: Gentle
    horizon: tuple[int, int]  # knots to an interval, intervals
    weights: Weights


KNOT_US, MARGIN_US = 4096, 12288


def text_of(draft: Draft) -> str:
    """The file's text."""
    lines = [
        f"name: {draft.name}",
        "duration_s: 10",
        "",
        "machine:",
        f"  model: {_quoted(draft.model)}",
    ]
    lines += ["  axes:", *(line for axis in draft.axes for line in _axis(axis))]
    lines += ["", "loop:", f"  knot_us: {KNOT_US}", f"  margin_us: {MARGIN_US}"]
    lines += ["", "task:", "  kind: sines", *_task(draft)]
    lines += ["", "mpc:", *_mpc(draft)]
    lines += ["", "estimator:", *_estimator(draft.weights)]
    head = HEAD.format(name=draft.name, file=draft.model, schema=draft.schema)
    return head + "\n" + "\n".join(lines) + "\n"


def _axis(axis: AxisGuess) -> list[str]:
    lines = _section(axis.kind, axis.values, "", "      ")
    return [f"    - joint: {_quoted(axis.joint.name)}", *lines]


def _section(kind: type[Section], values: dict[str, Value], prefix: str, indent: str) -> list[str]:
    """The given values of a section of the config, in the schema's order."""
    lines = []
    for attribute, info in kind.model_fields.items():
        name = prefix + attribute
        if name in values:
            value = values[name]
            lines.append(_line(indent, kind.key(attribute), _number(value.number), value.why))
        elif any(given.startswith(f"{name}.") for given in values):
            assert isinstance(info.annotation, type) and issubclass(info.annotation, Section)
            lines.append(f"{indent}{attribute}:")
            lines += _section(info.annotation, values, f"{name}.", indent + "  ")
    return lines


def _task(draft: Draft) -> list[str]:
    task, why = draft.task, "slow and small enough for half of each effort limit"
    lines = [_line("  ", "frequency_Hz", _number(task.frequency_Hz), why), "  axes:"]
    for i, axis in enumerate(draft.axes):
        offset, amplitude = _number(float(task.centre[i])), _number(float(task.amplitude[i]))
        phase, u = _number(float(task.phase_rad[i])), axis.unit
        keys = f"offset_{u}: {offset}, amplitude_{u}: {amplitude}, phase_rad: {phase}"
        lines.append(f"    - {{{keys}}}  # guessed: about the middle of the range")
    return lines


def _mpc(draft: Draft) -> list[str]:
    stride, intervals = draft.horizon
    horizon_us, why = stride * intervals * KNOT_US, "twice what the task needs to stop, or more"
    weights = draft.weights
    return [
        _line("  ", "horizon_us", str(horizon_us), why),
        _line("  ", "intervals", str(intervals), "see horizon_us"),
        _line("  ", "position_weight", _list(weights.position), BY_AXIS),
        _line("  ", "velocity_weight", _list(weights.velocity), BY_AXIS),
        _line("  ", "torque_step_weight", _list(weights.torque_step), BY_AXIS),
        _line("  ", "torque_start_weight", _list(weights.torque_start), BY_AXIS),
        _line("  ", "soft_weight", _list(weights.soft), BY_AXIS),
        # OSQP, the default, is at its cap in most ticks from four axes on.
        _line("  ", "backend", "riccati", ""),
    ]


def _estimator(weights: Weights) -> list[str]:
    acceleration, disturbance = weights.acceleration_noise, weights.disturbance_noise
    return [
        _line("  ", "acceleration_noise_rad_or_m_per_s15", _list(acceleration), BY_AXIS),
        _line("  ", "disturbance_noise_Nm_or_N_per_s05", _list(disturbance), BY_AXIS),
    ]


def _line(indent: str, key: str, value: str, why: str) -> str:
    line = f"{indent}{key}: {value}"
    return f"{line:<{COMMENT_COLUMN}}  # guessed: {why}" if why else line


def _number(number: float) -> str:
    """Shortest decimal of twelve digits, and a float stays one for YAML; or true."""
    if number is True:
        return "true"
    if number == int(number) and abs(number) < 1e9:
        return str(int(number))
    return f"{number:.12g}"


def _list(numbers: Array) -> str:
    return "[" + ", ".join(f"{number:.3g}" for number in numbers) + "]"


def _quoted(name: str) -> str:
    """A name or path as YAML text, whatever it looks like."""
    plain = re.fullmatch(r"[A-Za-z_./][A-Za-z0-9_./-]*[A-Za-z0-9_]", name)
    if plain and name.lower() not in {"true", "false", "null", ".nan", ".inf"}:
        return name
    return "'" + name.replace("'", "''") + "'"
