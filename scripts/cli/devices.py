"""`headway devices`: what is connected, how it is, and the settings that it has."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter
from rich.console import Console
from rich.table import Table

from headway.cli.changes import Changes, changed_config
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import Factor, Kind, Linked
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.devices.axis import AxisUnits
    from headway.devices.port_link import PortLink
    from headway.devices.remote import Remote

ANSWER_S = 3.0  # for what a device is asked
LISTEN_S = 1.0  # for clocks and counters
DRAIN_S = 0.2  # for answers to what was asked more than once
MISSING = "missing"

HELP = """What is connected, how it is, and the settings that it has.

Example: which boards of the arm are there, and how are they?

    headway devices list configs/arm2.yaml
"""

devices = App(name="devices", help=HELP, help_format="markdown")

Json = Annotated[bool, Parameter(name="--json", negative=())]


@dataclass(frozen=True)
class Where:
    """What all of these commands take."""

    link: Kind = "serial"
    """How the devices are reached: serial or udp."""
    realtime_factor: Factor = 1.0
    """As of `headway plant`."""
    keys: Path | None = None
    """The folder of the machine's keys. Default: ~/.config/headway/keys/NAME."""
    ports: Path | None = None
    """The folder where plants leave their ports' names. Default: headway/ in $XDG_RUNTIME_DIR."""
    overrides: Changes = None
    """Changes one key of the config; may be repeated."""


Place = Annotated[Where, Parameter(name="*")]
HERE = Where()


@devices.command(name="list")
def list_(config: Path, /, *, where: Place = HERE, to_json: Json = False) -> int:
    """Lists the devices of a machine: port, name, firmware, state, clock, faults, counters.

    Begins a session with each device that rests, as a controller does; of one that moves, which is
    somebody else's, it tells only that it is there. Those that do not answer are listed as missing,
    with what was found at each port, and the exit code is 4.

    Example: as a table, and for a script.

        headway devices list configs/arm2.yaml --link udp
        headway devices list configs/arm2.yaml --link udp --json

    Parameters
    ----------
    config
        The YAML file of a machine.
    to_json
        Prints the same as JSON.
    """
    with attached(config, where, all_of_them=False) as room:
        for remote in room.remotes:
            remote.ask_settings()
            remote.ask("FAULTS")
        room.run(lambda remote: remote.settings is not None and remote.faults is not None)
        room.listen(LISTEN_S)
        rows = room.rows()
    if to_json:
        print(json.dumps(rows, indent=2))
    else:
        Console().print(_table(rows))
    if room.missing:
        print(room.missing, file=sys.stderr)
    return ExitCode.DEVICE if room.missing else ExitCode.DONE


@devices.command(name="set")
def set_(config: Path, /, *, where: Place = HERE) -> int:
    """Gives each device the settings that its config makes, until its next power-up.

    Only a device at rest with its output off takes them. Its key stays.

    Example: other gains for a first try.

        headway devices set configs/arm2.yaml --set machine.axes.0.servo.kp_Nm_per_rad=90

    Parameters
    ----------
    config
        The YAML file of a machine.
    """
    from headway.devices.settings import device_settings

    with attached(config, where) as room:
        c = room.config
        try:
            wanted = [device_settings(a, c.device, c.loop, c.sync) for a in c.machine.boards]
        except ValueError as error:
            raise Failure(ExitCode.USAGE, f"{config}: {error}") from error
        for remote in room.remotes:
            remote.ask_settings()
        room.run(lambda remote: remote.settings is not None)
        room.listen(DRAIN_S)
        for settings, remote in zip(wanted, room.remotes, strict=True):
            if remote.settings is not None:  # where it is is not the config's to say
                settings.offset_count = remote.settings.offset_count
        return room.give([settings.encode() for settings in wanted])


@devices.command
def save(config: Path, /, *, where: Place = HERE, out: Path | None = None) -> int:
    """Has each device keep the settings that it has now, also without power.

    Example: keep them, with a copy for `headway devices restore`.

        headway devices save configs/arm2.yaml --out arm2-settings.json

    Parameters
    ----------
    config
        The YAML file of a machine.
    out
        A file for a copy, without keys. It must not exist yet.
    """
    with attached(config, where) as room:
        for remote in room.remotes:
            remote.ask_settings()
            remote.ask("SAVE")
        room.run(lambda remote: remote.settings is not None and remote.answer() is not None)
        answers = {joint: r.answer() for joint, r in zip(room.joints, room.remotes, strict=True)}
        copy = {
            joint: remote.settings.encode().hex()
            for joint, remote in zip(room.joints, room.remotes, strict=True)
            if remote.settings is not None
        }
    if out is not None:
        try:
            with out.open("x", encoding="utf-8") as file:
                json.dump(copy, file, indent=2)
        except OSError as error:
            raise Failure(ExitCode.USAGE, f"--out {out}: {error.strerror}") from error
    return verdict(answers, "kept", "its output is on" if "NOT_NOW" in answers.values() else "")


@devices.command
def restore(config: Path, copy: Path, /, *, where: Place = HERE) -> int:
    """Gives each device the settings of a copy that `headway devices save` has made.

    They hold until the next power-up; `headway devices save` has them kept.

    Example: back to what was good.

        headway devices restore configs/arm2.yaml arm2-settings.json

    Parameters
    ----------
    config
        The YAML file of a machine.
    copy
        The file.
    """
    from headway.firmware import _core

    with attached(config, where) as room:
        try:
            texts = json.loads(copy.read_text(encoding="utf-8"))
            wanted = [bytes.fromhex(texts[joint]) for joint in room.joints]
            good = all(_core.DeviceSettings.decode(each) is not None for each in wanted)
        except OSError as error:
            raise Failure(ExitCode.USAGE, f"{copy}: {error.strerror}") from error
        except (ValueError, LookupError, TypeError):
            good = False
        if not good:
            raise Failure(
                ExitCode.USAGE,
                f"{copy}: is no copy of the settings of {', '.join(room.joints)}: make one with "
                "`headway devices save --out`",
            )
        return room.give(wanted)


class Room:
    """The devices of a machine, for as long as they are talked to."""

    def __init__(
        self, config: Config, model: Path, joints: list[str], remotes: list[Remote],
        link: PortLink, clock: WallClock, missing: str,
    ) -> None:  # fmt: skip
        """`joints`: of the remotes. `missing`: what to say of the others, if there are any."""
        self.config, self.joints, self.remotes = config, joints, remotes
        self.model = model  # its file
        self._link, self._clock, self.missing = link, clock, missing
        by_joint = {axis.joint: axis for axis in config.machine.boards}
        self._axes = [by_joint[joint] for joint in joints]

    def index(self, axis: str) -> int:
        """Of an axis, by its joint. Raises Failure."""
        if axis not in self.joints:
            raise Failure(
                ExitCode.USAGE, f"{axis}: there is no such axis; there are {', '.join(self.joints)}"
            )
        return self.joints.index(axis)

    def units(self, device: int) -> AxisUnits:
        """The board's quanta."""
        from headway.devices.axis import AxisUnits

        return AxisUnits.of(self._axes[device], self.config.loop)

    def state(self, device: int) -> str:
        """As it told last."""
        from headway.devices.stop import STATES

        status = self.remotes[device].status
        return "unknown" if status is None else STATES[status.state]

    def position(self, device: int) -> float | None:
        """Where its axis was last [rad or m]; None while it does not know."""
        status = self.remotes[device].status
        if status is None or not status.homed or not status.samples:
            return None
        return float(status.samples[-1][1] / self._axes[device].counts_per_unit)

    def run(self, done: Callable[[Remote], bool], patience_s: float = ANSWER_S) -> None:
        """Attends until all are done, or patience is over."""
        end_us = self._clock.now_us() + round(patience_s * 1e6)
        while not all(done(r) for r in self.remotes) and self._clock.now_us() < end_us:
            self.listen(0)

    def ask(self, devices: Sequence[int], kind: str, argument: int = 0) -> dict[str, str | None]:
        """Has these carry out a command; tells what they answered, by joint, None for nothing."""
        asked = [self.remotes[i] for i in devices]
        for remote in asked:
            remote.ask(kind, argument)
        self.run(lambda remote: remote not in asked or remote.answer() is not None)
        return {self.joints[i]: self.remotes[i].answer() for i in devices}

    def listen(self, seconds: float) -> None:
        """Attends for a while, or for one knot."""
        from headway.devices.attend import attend

        knot_us = self.config.loop.knot_us
        now_us = self._clock.now_us()
        end_us = now_us + round(seconds * 1e6)
        while True:
            now_us = now_us // knot_us * knot_us + knot_us
            self._clock.wait_until(now_us)
            attend(self.remotes, self._link, now_us)
            now_us = max(now_us, self._clock.now_us())
            if now_us >= end_us:
                return

    def give(self, wanted: list[bytes]) -> int:
        """Tells settings, and whether the devices have them now."""
        from headway.firmware import _core

        for remote, each in zip(self.remotes, wanted, strict=True):
            remote.ask_settings(_core.DeviceSettings.decode(each))
        self.run(lambda remote: remote.settings is not None)
        answers: dict[str, str | None] = {}
        for joint, remote, each in zip(self.joints, self.remotes, wanted, strict=True):
            if remote.settings is not None:
                answers[joint] = "DONE" if remote.settings.encode() == each else "refused"
            else:
                answers[joint] = None
        return verdict(answers, "taken", "a device takes settings at rest with its output off")

    def rows(self) -> list[dict[str, Any]]:
        """What there is to tell of each device of the machine."""
        return [
            self._told(self.joints.index(axis.joint))
            if axis.joint in self.joints
            else {"axis": axis.joint, "port": None, "usb": "", "state": MISSING}
            for axis in self.config.machine.boards
        ]

    def _told(self, device: int) -> dict[str, Any]:
        from headway.devices.places import usb_of
        from headway.devices.stop import REASONS, STATES

        remote, status = self.remotes[device], self.remotes[device].status
        row: dict[str, Any] = {
            "axis": self.joints[device],
            "port": self._link.names[device],
            "usb": usb_of(self._link.names[device]),
            "state": "somebody else's" if status is None else STATES[status.state],
        }
        if status is None:
            return row
        clock = remote.clock.state(self._clock.now_us())
        faults = remote.faults or []
        return row | {
            "name": remote.settings.name if remote.settings else None,
            "firmware": remote.firmware,
            "position": self.position(device),
            "synced": status.synced,
            "clock_us": None if clock.least_us is None else [clock.least_us, clock.most_us],
            "round_trip_us": clock.round_trip_us,
            "faults": [REASONS[fault.reason] for fault in faults],
            "frames_lost": remote.lost,
            "frames_bad_here": remote.frames_bad,
            "frames_bad_there": status.frames_bad,
        }


@contextmanager
def attached(path: Path, where: Where, all_of_them: bool = True) -> Iterator[Room]:
    """The devices, with a session each where they let us; or those that answer. Raises Failure."""
    linked = Linked(where.link, where.realtime_factor, False, where.keys, where.ports, False)
    linked.check()
    config = changed_config(path, list(where.overrides or []))
    with linked.machine(path, config, []) as reached:
        clock = WallClock(linked.factor)
        with reached.some(clock) as (link, joints, missing):
            if missing and all_of_them:
                raise Failure(ExitCode.DEVICE, missing)
            remotes = dict(zip(reached.keys.devices, reached.remotes(), strict=True))
            model = (path.parent / config.machine.model).resolve()
            ours = [remotes[joint] for joint in joints]
            room = Room(config, model, joints, ours, link, clock, missing)
            room.run(lambda remote: remote.established)
            yield room


def verdict(answers: dict[str, str | None], done: str, hint: str) -> int:
    for joint, answer in answers.items():
        told = {None: "no answer", "DONE": done}.get(answer, answer)
        print(f"{joint}: {told}")
    if all(answer == "DONE" for answer in answers.values()):
        return ExitCode.DONE
    if hint:
        print(hint, file=sys.stderr)
    return ExitCode.DEVICE


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table("axis")
    for head, key in (("port", "port"), ("USB", "usb"), ("state", "state")):  # what may be copied
        longest = max(len(row[key] or "") for row in rows)
        table.add_column(head, no_wrap=True, min_width=longest)
    for head in ("name", "firmware", "clock within [us]", "faults", "lost", "bad here",
                 "bad there"):  # fmt: skip
        table.add_column(head)
    for row in rows:
        within = row.get("clock_us")
        faults = row.get("faults")
        table.add_row(
            row["axis"], row["port"] or "-", row["usb"] or "-", row["state"],
            row.get("name") or "-", _shown(row, "firmware"),
            "-" if within is None else f"{within[0]:.0f} .. {within[1]:.0f}",
            "-" if faults is None else ", ".join(faults) or "none",
            *(_shown(row, key) for key in ("frames_lost", "frames_bad_here", "frames_bad_there")),
        )  # fmt: skip
    return table


def _shown(row: dict[str, Any], key: str) -> str:
    return "-" if row.get(key) is None else str(row[key])
