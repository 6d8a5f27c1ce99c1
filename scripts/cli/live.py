"""`headway run --link`: the loop against devices at real ports."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from headway.cli.claim import LOOP, claimed
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import (
    Kind,
    check_factor,
    find_ports,
    machine_keys,
    operating_system_rng,
    place_folder,
)
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.controller.live import Live
    from headway.controller.record.recorder import Recorder
    from headway.devices.keys import Keys
    from headway.devices.port import Port
    from headway.devices.port_link import PortLink

PLANT_NAME = "plant.mcap"  # what a spawned plant leaves in the run's folder
MAIN = "import sys; from headway.cli.main import main; sys.exit(main())"
END_S = 10.0  # for a spawned plant to finish its record


@dataclass(frozen=True)
class Linked:
    """How the devices are reached, as the command line says."""

    kind: Kind
    factor: float = 1.0
    spawn: bool = False
    keys: Path | None = None
    ports: Path | None = None

    def check(self) -> None:
        """Raises Failure for what does not go together."""
        check_factor(self.factor)
        if self.spawn and (self.keys or self.ports):
            raise Failure(
                ExitCode.USAGE,
                "--spawn starts a plant with keys and ports of its own: leave --keys and --ports "
                "out, or start `headway plant` yourself",
            )


@contextmanager
def live(
    linked: Linked, path: Path, config: Config, overrides: list[str], folder: Path, record: Recorder
) -> Iterator[tuple[Live, PortLink]]:
    """The loop with its devices found, ready to run, and its link; afterwards all is closed.

    Raises Failure where something cannot be found or does not fit.
    """
    with ExitStack() as stack:
        ports, alive = linked.ports, _always
        keys: Keys
        if linked.spawn:
            home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="headway-")))
            keys, ports = _ephemeral(home, config), home / "ports"
            plant = stack.enter_context(
                _spawned(linked, path, overrides, home, folder / PLANT_NAME)
            )
            alive = plant.alive
        else:
            keys = machine_keys(config, path, linked.keys)
        loop, link = _loop(linked, path, config, keys, place_folder(ports), alive, record, stack)
        try:
            yield loop, link
        except Failure as failure:
            if not link.gone:
                raise
            raise Failure(failure.code, "\n".join([*link.gone.values(), str(failure)])) from failure


def _always() -> bool:
    return True


def _ephemeral(home: Path, config: Config) -> Keys:
    from headway.devices.keys import draw_keys, read_keys

    names = [axis.joint for axis in config.machine.axes]
    draw_keys(home / "keys", names)
    return read_keys(home / "keys", names)


class _Spawned:
    """A plant that this process has started."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

    def alive(self) -> bool:
        """Whether it still runs."""
        return self.process.poll() is None


@contextmanager
def _spawned(
    linked: Linked, path: Path, overrides: list[str], home: Path, record: Path
) -> Iterator[_Spawned]:
    """A plant of our own. It ends with us, however we end."""
    words = ["plant", str(path), "--link", linked.kind, "--realtime-factor", str(linked.factor)]
    words += ["--keys", str(home / "keys"), "--ports", str(home / "ports")]
    words += ["--record", str(record), "--until-eof"]
    words += [word for change in overrides for word in ("--set", change)]
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the loop, which the plant outlives
    )
    try:
        yield _Spawned(process)
    finally:
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _loop(
    linked: Linked,
    path: Path,
    config: Config,
    keys: Keys,
    places: Path,
    alive: Callable[[], bool],
    record: Recorder,
    stack: ExitStack,
) -> tuple[Live, PortLink]:
    from headway.controller.live import Live
    from headway.controller.loop import Loop
    from headway.controller.reference import Sines
    from headway.devices.bus import Bus
    from headway.devices.core import COAST_KNOTS
    from headway.devices.places import open_places
    from headway.devices.port_link import PortLink
    from headway.devices.remote import Remote
    from headway.devices.session import Session
    from headway.models.machine import load_machine

    rng = operating_system_rng()
    patience_us = COAST_KNOTS * config.loop.knot_us
    marks = Bus(len(config.machine.axes)) if config.sync.one_bus else None
    remotes = [
        Remote(Session(key, rng), patience_us, device, marks)
        for device, key in enumerate(keys.devices.values())
    ]
    try:
        machine = load_machine((path.parent / config.machine.model).resolve())
        loop = Loop(config, machine, remotes, Sines(config.task), record)
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error

    def open_all() -> tuple[list[Port], list[str]]:
        return open_places(places, linked.kind == "udp")

    ports = find_ports(keys, open_all, rng, alive)
    clock = WallClock(linked.factor)
    for refused in stack.enter_context(claimed(LOOP)):
        print(refused, file=sys.stderr)
    link = PortLink(ports, clock.now_us)
    stack.callback(link.close)
    return Live(config, loop, remotes, link, record, clock), link
