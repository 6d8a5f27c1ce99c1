"""`headway plant`: the simulated machine as a process of its own, behind real ports."""

from __future__ import annotations

import shlex
import shutil
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from headway.cli.changes import Changes, changed_config
from headway.cli.claim import PLANT, claimed
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import (
    SCRATCH_KEYS,
    SCRATCH_PORTS,
    Factor,
    Kind,
    check_factor,
    machine_keys,
    place_folder,
)
from headway.cli.stopping import Stoppable, signals_stop
from headway.cli.wall import WallClock

LOOPBACK, EVERYWHERE = "127.0.0.1", "0.0.0.0"

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
    port: int = 0,
    record: Path | None = None,
    seed: int | None = None,
    overrides: Changes = None,
    until_eof: Annotated[bool, Parameter(negative=())] = False,
    scratch: Path | None = None,
) -> int:
    """Runs a machine's devices and its simulated mechanics, for controllers in other processes.

    Each device runs the firmware and is reached over a pty or a UDP port on loopback, as a board
    would be; nothing but bytes passes. The simulated network of the config lies between port and
    board, so a frame takes what `sim.to_device` and `sim.to_host` say and what the port takes.
    Mishaps of the config, which belong to a task, do not happen here. Ctrl-C ends it.

    Example: a plant in one terminal, its controller in another.

        headway keys configs/arm2.yaml
        headway plant configs/arm2.yaml --link udp --set sync.limit_us=1000
        headway run configs/arm2.yaml --link udp --set sync.limit_us=1000

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
    port
        The UDP port of the first device; the next ones follow it. Default: any that are free.
    record
        A file for the plant's own account, as run.mcap has it: truth and servos, every
        millisecond, while an output is on. It must not exist yet.
    seed
        Of everything random, instead of the config's seed.
    overrides
        Changes one key of the config; may be repeated.
    until_eof
        Ends when standard input does: with whoever started it.
    scratch
        The folder that `headway run --spawn` has made for keys and ports: removed at the end, since
        whoever made it may have been killed.
    """
    check_factor(realtime_factor)
    changes = list(overrides or []) + ([] if seed is None else [f"seed={seed}"])
    checked = changed_config(config, changes)
    _check_port(port, link, len(checked.machine.boards))
    devices = machine_keys(checked, config, keys)
    folder = place_folder(ports)
    if bind != LOOPBACK and link != "udp":
        raise Failure(ExitCode.USAGE, f"--bind {bind}: ptys are not bound: add --link udp")
    with ExitStack() as stack:
        if scratch is not None:
            stack.callback(remove_scratch, scratch)
        recording = _record(record, checked, config.parent, stack)
        outlets = [
            stack.enter_context(
                outlet_at(link, folder, checked.name, axis.joint, bind, port and port + number)
            )
            for number, axis in enumerate(checked.machine.boards)
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
        for axis, outlet in zip(checked.machine.boards, outlets, strict=True):
            print(f"{axis.joint}: {outlet.where}")
        addresses = [] if bind == LOOPBACK else [_reachable(outlet.where) for outlet in outlets]
        words = _command(config, link, realtime_factor, keys, ports, list(overrides or []))
        print(f"to control it: {shlex.join(words + _elsewhere(addresses))}", flush=True)
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


def remove_scratch(folder: Path) -> None:
    """Removes what `headway run --spawn` has put there, and the folder, unless there is more."""
    for name in (SCRATCH_KEYS, SCRATCH_PORTS):
        shutil.rmtree(folder / name, ignore_errors=True)
    with suppress(OSError):
        folder.rmdir()


def stop_at_eof(what: Stoppable) -> None:
    """Sees to it that something stops with whoever has started this process."""

    def watch() -> None:
        while sys.stdin.buffer.read(4096):
            pass
        what.stopping = True

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def outlet_at(
    link: Kind, folder: Path, machine: str, device: str, bind: str = LOOPBACK, port: int = 0
) -> Iterator[Outlet]:
    """A place at which a device can be reached, while it is needed. Raises Failure."""
    from headway.sim.outlet import PtyOutlet, UdpOutlet

    try:
        outlet: Outlet
        if link == "serial":
            outlet = PtyOutlet(folder, machine, device)
        else:
            outlet = UdpOutlet(folder, machine, device, (bind, port))
    except OSError as error:
        where = f"at {bind}:{port}" if port else f"in {folder}"
        reason = f"{device}: no port can be offered {where}: {error.strerror}"
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


def _check_port(port: int, link: Kind, devices: int) -> None:
    """Raises Failure."""
    if port and link != "udp":
        raise Failure(ExitCode.USAGE, f"--port {port}: ptys have none: add --link udp")
    if port and not 1024 <= port <= 65536 - devices:
        raise Failure(
            ExitCode.USAGE,
            f"--port {port}: give 1024 to {65536 - devices}, the first of {devices} ports; or leave"
            " it out for any that are free",
        )


def _command(
    config: Path, link: Kind, factor: float, keys: Path | None, ports: Path | None,
    changes: list[str],
) -> list[str]:  # fmt: skip
    """The words that control this plant from this computer."""
    words = ["headway", "run", str(config), "--link", link]
    words += [] if factor == 1 else ["--realtime-factor", f"{factor:g}"]
    words += [] if keys is None else ["--keys", str(keys)]
    words += [] if ports is None else ["--ports", str(ports)]
    return words + [word for change in changes for word in ("--set", change)]


def _reachable(where: str) -> str:
    """An address as others have it: by this computer's name, if it is bound to all it has."""
    host, _, port = where.rpartition(":")
    return f"{socket.gethostname() if host == EVERYWHERE else host}:{port}"


def _elsewhere(addresses: list[str]) -> list[str]:
    """What a controller has to be told besides on another computer, which has no files of ours."""
    return ["--set", f"links.udp=[{', '.join(addresses)}]"] if addresses else []
