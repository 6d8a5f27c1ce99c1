"""`headway devices`: what an operator asks of single devices, outside of a run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from headway.cli.devices import HERE, Json, Place, Room, attached, devices, verdict
from headway.cli.failure import ExitCode, Failure

if TYPE_CHECKING:
    from headway.configs.axis import DrivenAxis
    from headway.devices.remote import Remote

SETTLE_S = 10.0  # for clocks, which arming needs
JOG_MOST_S = 10.0

Only = Annotated[str | None, Parameter(name="--axis")]


@devices.command
def faults(config: Path, /, *, where: Place = HERE, to_json: Json = False) -> int:
    """Tells each device's fault log, oldest first: the last eight, also of earlier boots.

    Example: why did it stop, and where was it?

        headway devices faults configs/arm2.yaml

    Parameters
    ----------
    config
        The YAML file of a machine.
    to_json
        Prints the same as JSON.
    """
    with attached(config, where) as room:
        for remote in room.remotes:
            remote.ask("FAULTS")
        room.run(lambda remote: remote.faults is not None)
        rows = [row for i in range(len(room.remotes)) for row in _log(room, i)]
        missing = [joint for joint, r in zip(room.joints, room.remotes, strict=True)
                   if r.faults is None]  # fmt: skip
    if to_json:
        print(json.dumps(rows, indent=2))
    else:
        for row in rows:
            print(
                f"{row['axis']}, boot {row['boot']}, {row['time_us'] * 1e-6:.6f} s, in "
                f"{row['state']}: {row['reason']}: {row['words']}; at {row['position']:.5g} "
                f"{row['unit']}, asked for {row['effort']:.4g} {row['effort_unit']}"
            )
        for joint in room.joints:
            if not any(row["axis"] == joint for row in rows) and joint not in missing:
                print(f"{joint}: no faults")
    return verdict(dict.fromkeys(missing), "told", "")


@devices.command
def stop(config: Path, /, *, where: Place = HERE) -> int:
    """Asks every device that moves or is armed to come to rest by its own ramp, and then to brake.

    A device that runs for another host takes no command of ours: stop that run.

    Example: after a run that was killed.

        headway devices stop configs/arm2.yaml

    Parameters
    ----------
    config
        The YAML file of a machine.
    """
    with attached(config, where) as room:
        every = range(len(room.remotes))
        room.ask(every, "STOP")
        return verdict(_released(room, every), "at rest, off", "")


@devices.command
def clear(config: Path, /, *, where: Place = HERE, axis: Only = None) -> int:
    """Clears a fault or an emergency stop whose cause is gone; nothing moves by that.

    Example: once the emergency line is closed again.

        headway devices clear configs/arm2.yaml

    Parameters
    ----------
    config
        The YAML file of a machine.
    axis
        One axis, by its joint. Default: all that are latched.
    """
    with attached(config, where) as room:
        room.run(lambda remote: remote.status is not None)
        latched = [i for i in range(len(room.remotes)) if room.state(i) in ("FAULT", "ESTOP")]
        chosen = latched if axis is None else [room.index(axis)]
        answers = room.ask(chosen, "CLEAR")
        if not chosen:
            print("no device is latched")
        hint = "CAUSE: it is still there (`headway devices faults`); MOVING: its output is on yet"
        return verdict(answers, "cleared", hint)


@devices.command
def zero(config: Path, axis: str, position: float = 0.0, /, *, where: Place = HERE) -> int:
    """Tells a device where its axis is now, which it counts from then on.

    `headway devices save` has it kept: for an encoder that knows its angle without power.

    Example: the elbow lies at its mark, which is at a quarter of a turn.

        headway devices zero configs/arm2.yaml q2 1.5708

    Parameters
    ----------
    config
        The YAML file of a machine.
    axis
        The axis, by its joint.
    position
        Where it is [rad or m].
    """
    with attached(config, where) as room:
        i = room.index(axis)
        count = round(position * room.config.machine.boards[i].counts_per_unit)
        if not -(2**31) <= count < 2**31:
            raise Failure(ExitCode.USAGE, f"{position}: is beyond what the encoder counts")
        answers = room.ask([i], "ZERO", count)
        hint = "a device takes it at rest with its output off"
        return verdict(answers, f"at {position:g}", hint)


@devices.command
def home(config: Path, axis: str, /, *, where: Place = HERE) -> int:
    """Lets one axis look for its mark, as a run does at its start, and switches it off again.

    Example: before the first run after power-up.

        headway devices home configs/machine.yaml q1

    Parameters
    ----------
    config
        The YAML file of a machine.
    axis
        The axis, by its joint; it needs `homing` in the config.
    """
    with attached(config, where) as room:
        i, driven = _driven(room, axis)
        if driven.homing is None:
            raise Failure(ExitCode.USAGE, f"{axis}: the config has no homing for it")
        most_s = 2 * driven.homing.way / driven.homing.speed + 1
        remote = room.remotes[i]
        with _armed(room, i):
            _asked(room, i, "HOME")
            room.run(lambda r: r is not remote or _found(r) or _stopped(room, i), most_s)
        found = _found(remote) and not _stopped(room, i)
        return verdict({axis: "DONE" if found else "found no mark"}, "homed", "")


@devices.command
def jog(
    config: Path, axis: str, speed: float, /, *, where: Place = HERE, seconds: float = 1.0
) -> int:
    """Moves one axis slowly for a while, and switches it off again. Ctrl-C stops it.

    No faster than its homing speed (without homing 5 % of its speed limit), with no more feedback
    than its homing effort (without homing a quarter of its limit). The board ends it by itself when
    this computer falls silent.

    Example: away from where it touches.

        headway devices jog configs/arm2.yaml q2 -0.1 --seconds 2

    Parameters
    ----------
    config
        The YAML file of a machine.
    axis
        The axis, by its joint.
    speed
        Its speed [rad/s or m/s].
    seconds
        How long, at most 10.
    """
    if not 0 < seconds <= JOG_MOST_S:
        raise Failure(ExitCode.USAGE, f"--seconds {seconds:g}: from 0 to {JOG_MOST_S:g}")
    with attached(config, where) as room:
        from headway.devices.settings import home_settings

        i, driven = _driven(room, axis)
        units, period_us = room.units(i), room.config.device.servo_period_us
        speed_q16 = round(speed * units.pq_per_unit * period_us * 1e-6 * 65536)
        most_q16 = home_settings(driven, room.config.device, units).speed_q16
        if abs(speed_q16) > most_q16:
            most = abs(speed) * most_q16 / abs(speed_q16)
            raise Failure(ExitCode.USAGE, f"{speed:g}: {axis} jogs at up to {most:.4g}")
        with _armed(room, i):
            _asked(room, i, "JOG", speed_q16)
            room.listen(seconds)
            _asked(room, i, "JOG", 0)
        return verdict({axis: "stopped" if _stopped(room, i) else "DONE"}, "moved", "")


def _driven(room: Room, axis: str) -> tuple[int, DrivenAxis]:
    i = room.index(axis)
    if i not in room.config.machine.driven:
        raise Failure(ExitCode.USAGE, f"{axis}: has no motor")
    return i, room.config.machine.driven[i]


def _log(room: Room, device: int) -> list[dict[str, Any]]:
    from headway.devices.stop import REASONS, STATES, words

    axis, units = room.config.machine.boards[device], room.units(device)
    period_us = room.config.device.servo_period_us
    return [
        {
            "axis": room.joints[device],
            "boot": fault.boots,
            "time_us": fault.time_us,
            "state": STATES[fault.state],
            "reason": REASONS[fault.reason],
            "words": words(REASONS[fault.reason], fault.value, fault.limit, axis, units, period_us),
            "position": fault.position_pq / units.pq_per_unit,
            "unit": axis.unit,
            "effort": fault.torque_tq / units.tq_per_effort,
            "effort_unit": axis.effort_unit,
        }
        for fault in room.remotes[device].faults or []
    ]


@contextmanager
def _armed(room: Room, device: int) -> Iterator[None]:
    """One device with its load taken; switched off at the end, at rest, whatever happens."""
    remote = room.remotes[device]
    room.run(lambda r: r is not remote or room.state(device) != "UNSYNCED", SETTLE_S)
    if room.state(device) == "HOLD":  # it has its load already
        _asked(room, device, "RESUME")
    else:
        _asked(room, device, "ARM", _holding(room, device))
    try:
        yield
    except BaseException:
        remote.ask("STOP")
        room.listen(0.2)
        _released(room, [device])
        raise
    if _released(room, [device])[room.joints[device]] is None:
        raise Failure(ExitCode.DEVICE, "it does not switch off: see `headway devices list`")


def _asked(room: Room, device: int, kind: str, argument: int = 0) -> None:
    """Raises Failure if the device does not do it."""
    ((joint, answer),) = room.ask([device], kind, argument).items()
    if answer != "DONE":
        state = room.state(device)
        raise Failure(ExitCode.DEVICE, f"{joint}: {kind} gave {answer or 'no answer'}, in {state}")


def _released(room: Room, chosen: Sequence[int]) -> dict[str, str | None]:
    """Switches devices off, once each of them rests."""
    for _ in range(20):
        for i in chosen:
            if room.state(i) in ("ARMED", "HOLD"):
                room.remotes[i].ask("DISARM")
        room.listen(0.2)
        if all(room.state(i) not in ("ARMED", "TAIL", "HOLD", "RUNNING", "COAST") for i in chosen):
            return {room.joints[i]: "DONE" for i in chosen}
    return {room.joints[i]: None for i in chosen}


def _found(remote: Remote) -> bool:
    return remote.status is not None and remote.status.homed


def _stopped(room: Room, device: int) -> bool:
    return room.state(device) in ("TAIL", "HOLD", "FAULT", "ESTOP")


def _holding(room: Room, device: int) -> int:
    """The torque that holds the axis where the machine is, by its model [tq]; none where a device
    does not know where it is."""
    import numpy as np

    from headway.models.machine import load_machine

    position = [room.position(i) for i in range(len(room.remotes))]
    if None in position:
        return 0
    machine = load_machine(room.model, room.config.machine.coupling)
    effort = machine.holding(np.array([position]))[0, device : device + 1]
    return int(room.units(device).torque_points(effort)[0])
