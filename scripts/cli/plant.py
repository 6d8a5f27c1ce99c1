"""`headway plant`: the simulated machine as a process of its own, behind real ports."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from headway.cli.changes import Changes, changed_config
from headway.cli.claim import PLANT, claimed
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import Factor, Kind, check_factor, machine_keys, place_folder
from headway.cli.stopping import Stoppable, signals_stop
from headway.cli.wall import WallClock

LOOPBACK = "127.0.0.1"

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.controller.record.recording import Recording
    from headway.sim.outlet import Outlet


def plant(
    config: Path,
    /,
    *,
    link: Kind = "serial",
    realtime_factor: Factor = 1.0,
    keys: Path | None = None,
    ports: Path | None = None,
    bind: str = LOOPBACK,
    record: Path | None = None,
    seed: int | None = None,
    overrides: Changes = None,
    until_eof: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Runs a machine's devices and its simulated mechanics, for controllers in other processes.

    Each device runs the firmware and is reached over a pty or a UDP port on loopback, as a board
    would be; nothing but bytes passes. The simulated network of the config lies between port and
    board, so a frame takes what `sim.to_device` and `sim.to_host` say and what the port takes.
    Mishaps of the config, which belong to a task, do not happen here. Ctrl-C ends it.

    Example: a plant in one terminal, its controller in another.

        headway keys configs/arm2.yaml
        headway plant configs/arm2.yaml --link udp
        headway run configs/arm2.yaml --link udp

    Parameters
    ----------
    config
        The YAML file of a machine.
    link
        What each device is offered at: serial, a pty, or udp, a port on loopback.
    realtime_factor
        How fast time passes here: at 0.05 all clocks take twenty times as long. The controller
        needs the same.
    keys
        The folder of the machine's keys, with which the devices are set up. Default:
        ~/.config/headway/keys/NAME.
    ports
        The folder for the ports' stable names. Default: headway/ in $XDG_RUNTIME_DIR.
    bind
        The address of this computer at which UDP devices can be reached. Default: loopback, which
        is this computer alone.
    record
        A file for the plant's own account, as run.mcap has it: truth and servos, every
        millisecond, while an output is on. It must not exist yet.
    seed
        Of everything random, instead of the config's seed.
    overrides
        Changes one key of the config; may be repeated.
    until_eof
        Ends when standard input does: with whoever started it.
    """
    check_factor(realtime_factor)
    changes = list(overrides or []) + ([] if seed is None else [f"seed={seed}"])
    checked = changed_config(config, changes)
    devices = machine_keys(checked, config, keys)
    folder = place_folder(ports)
    if bind != LOOPBACK and link != "udp":
        raise Failure(ExitCode.USAGE, f"--bind {bind}: ptys are not bound: add --link udp")
    with ExitStack() as stack:
        recording = _record(record, checked, config.parent, stack)
        outlets = [
            stack.enter_context(outlet_at(link, folder, checked.name, axis.joint, bind))
            for axis in checked.machine.axes
        ]
        from headway.sim.plant import UnstableError
        from headway.sim.realtime import Realtime

        stack.enter_context(claimed(PLANT))
        try:
            machine = Realtime(
                checked, config.parent, devices, outlets, WallClock(realtime_factor), recording
            )
        except ValueError as error:
            raise Failure(ExitCode.USAGE, f"{config}: {' '.join(str(error).split())}") from error
        if bind != LOOPBACK:
            print(
                f"reachable from other computers, at {bind}: frames are authenticated, but nothing "
                "is encrypted (docs/security.md)",
                file=sys.stderr,
            )
        for axis, outlet in zip(checked.machine.axes, outlets, strict=True):
            print(f"{axis.joint}: {outlet.where}")
        print(f"to control it: {_command(config, link, realtime_factor, keys, ports)}", flush=True)
        if until_eof:
            stop_at_eof(machine)
        try:
            with signals_stop(machine):
                machine.run()
        except UnstableError as error:
            raise Failure(ExitCode.USAGE, str(error)) from error
    if machine.behind:
        print(
            f"the computer was too slow {machine.behind} times, by {machine.behind_us / 1000:.0f} "
            "ms at worst: to its devices that is a wire that stands still; a smaller "
            "--realtime-factor helps",
            file=sys.stderr,
        )
    if recording is not None and recording.failure:
        print(f"the record is incomplete: {recording.failure}", file=sys.stderr)
        return ExitCode.RECORD
    return ExitCode.DONE


def stop_at_eof(what: Stoppable) -> None:
    """Sees to it that something stops with whoever has started this process."""

    def watch() -> None:
        while sys.stdin.buffer.read(4096):
            pass
        what.stopping = True

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def outlet_at(
    link: Kind, folder: Path, machine: str, device: str, bind: str = LOOPBACK
) -> Iterator[Outlet]:
    """A place at which a device can be reached, while it is needed. Raises Failure."""
    from headway.sim.outlet import PtyOutlet, UdpOutlet

    try:
        outlet: Outlet
        if link == "serial":
            outlet = PtyOutlet(folder, machine, device)
        else:
            outlet = UdpOutlet(folder, machine, device, bind)
    except OSError as error:
        reason = f"{device}: no port can be offered in {folder}: {error.strerror}"
        raise Failure(ExitCode.USAGE, reason) from error
    try:
        yield outlet
    finally:
        outlet.close()


def _record(path: Path | None, config: Config, base: Path, stack: ExitStack) -> Recording | None:
    """Starts the plant's record. Raises Failure."""
    if path is None:
        return None
    from headway.cli.versions import versions
    from headway.configs.save import config_text
    from headway.controller.record.recording import Recording
    from headway.controller.record.target import About

    about = About(config_text(config, base), config.seed, versions())
    try:
        return stack.enter_context(Recording(path, about))
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"--record {path}: {error.strerror}") from error


def _command(config: Path, link: Kind, factor: float, keys: Path | None, ports: Path | None) -> str:
    import shlex

    words = ["headway", "run", str(config), "--link", link]
    words += [] if factor == 1 else ["--realtime-factor", f"{factor:g}"]
    words += [] if keys is None else ["--keys", str(keys)]
    words += [] if ports is None else ["--ports", str(ports)]
    return shlex.join(words)
