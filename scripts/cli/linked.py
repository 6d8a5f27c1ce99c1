"""What the commands that reach real devices share: keys, ports, a plant of their own, the clock."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from headway.cli.claim import LOOP, claimed
from headway.cli.failure import ExitCode, Failure
from headway.cli.wall import FACTORS, WallClock

if TYPE_CHECKING:
    import numpy as np

    from headway.configs.schema import Config
    from headway.devices.discovery import Search
    from headway.devices.keys import Keys
    from headway.devices.port import Port
    from headway.devices.port_link import PortLink
    from headway.devices.remote import Remote

Kind = Literal["serial", "udp"]
Factor = Annotated[float, Parameter(name="--realtime-factor")]
PATIENCE_S = 10.0  # until every device has to have answered
OWN_PATIENCE_S = 60.0  # with a plant of our own: that it has ended is seen at once
ROUND_S, ASK_S, LOOK_S = 2.0, 0.2, 0.01
END_S = 10.0  # for a spawned plant to finish its record
SCRATCH_KEYS, SCRATCH_PORTS = "keys", "ports"  # in the folder of a spawned plant
MAIN = "import sys; from headway.cli.main import main; sys.exit(main())"


@dataclass(frozen=True)
class Linked:
    """How the devices are reached, as the command line says."""

    kind: Kind
    factor: float = 1.0
    spawn: bool = False
    keys: Path | None = None
    ports: Path | None = None
    punctual: bool = True  # whether to ask the operating system for what claim.py does

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
    def machine(
        self, path: Path, config: Config, changes: Sequence[str], record: Path | None = None
    ) -> Iterator[Reached]:
        """The machine of the config at `path`; with a plant of our own, which keeps its own account
        in `record`, if that is asked for. Raises Failure."""
        if not self.spawn:
            keys = machine_keys(config, path, self.keys)
            yield Reached(self, config, keys, place_folder(self.ports), lambda: True, PATIENCE_S)
            return
        with ExitStack() as stack:
            home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="headway-")))
            keys = _ephemeral(home / SCRATCH_KEYS, config)
            plant = stack.enter_context(_spawned(self, path, changes, home, record))
            folder = place_folder(home / SCRATCH_PORTS)
            yield Reached(self, config, keys, folder, lambda: plant.poll() is None, OWN_PATIENCE_S)


@dataclass(frozen=True)
class Reached:
    """A machine whose devices can be asked for."""

    linked: Linked
    config: Config
    keys: Keys
    places: Path
    alive: Callable[[], bool]  # whether a plant of our own still runs
    patience_s: float  # with devices that do not answer

    def remotes(self) -> list[Remote]:
        """Its devices, of which nothing has been heard yet."""
        from headway.devices.bus import Bus
        from headway.devices.core import COAST_KNOTS
        from headway.devices.remote import Remote
        from headway.devices.session import Session

        rng = operating_system_rng()
        patience_us = COAST_KNOTS * self.config.loop.knot_us
        marks = Bus(len(self.keys.devices)) if self.config.sync.one_bus else None
        return [
            Remote(Session(key, rng), patience_us, device, marks)
            for device, key in enumerate(self.keys.devices.values())
        ]

    @contextmanager
    def link(self, clock: WallClock) -> Iterator[PortLink]:
        """Finds the devices and links them, in real time as far as this computer allows; says what
        it does not. Raises Failure."""
        ports = find_ports(
            self.keys, self._open_all, operating_system_rng(), self.patience_s, self.alive
        )
        with self._over(ports, clock) as link:
            yield link

    @contextmanager
    def some(self, clock: WallClock) -> Iterator[tuple[PortLink, list[str], str]]:
        """The same with those devices that answer: the link, their names in its order, and what was
        found at each port if one does not answer."""
        found, said = find_devices(
            self.keys, self._open_all, operating_system_rng(), self.patience_s, self.alive
        )
        names = [name for name in self.keys.devices if name in found]
        with self._over([found[name] for name in names], clock) as link:
            yield link, names, said

    def _open_all(self) -> tuple[list[Port], list[str]]:
        from headway.devices.places import open_places

        return open_places(self.places, self.config.links, self.linked.kind == "udp")

    @contextmanager
    def _over(self, ports: list[Port], clock: WallClock) -> Iterator[PortLink]:
        from headway.devices.port_link import PortLink

        with ExitStack() as stack:
            for what in stack.enter_context(claimed(LOOP)) if self.linked.punctual else ():
                print(what, file=sys.stderr)
            link = PortLink(ports, clock.now_us)
            try:
                yield link
            finally:
                link.close()


@dataclass(frozen=True)
class Over:
    """Options of a command that simulates, if it is not told of a link."""

    link: Kind | None = None
    """How the devices are reached: serial ports or udp. Default: not at all, they are simulated."""
    spawn: Annotated[bool, Parameter(negative=())] = False
    """Starts a plant with keys of its own for this, and ends it afterwards."""
    realtime_factor: float = 1.0
    """How fast time passes over a link: at 0.05 all clocks take twenty times as long. A plant needs
    the same."""
    keys: Path | None = None
    """The folder of the machine's keys. Default: ~/.config/headway/keys/NAME."""
    ports: Path | None = None
    """The folder where plants leave their ports' names. Default: headway/ in $XDG_RUNTIME_DIR."""

    def linked(self) -> Linked | None:
        """None: there is no link. Raises Failure."""
        if self.link is not None:
            linked = Linked(self.link, self.realtime_factor, self.spawn, self.keys, self.ports)
            linked.check()
            return linked
        if self.spawn or self.keys or self.ports or self.realtime_factor != 1:
            raise Failure(
                ExitCode.USAGE,
                "--spawn, --realtime-factor, --keys and --ports are for real links: add "
                "--link serial or --link udp",
            )
        return None


Link = Annotated[Over, Parameter(name="*")]
SIMULATED = Over()


def check_factor(factor: float) -> None:
    """Raises Failure."""
    if not FACTORS[0] <= factor <= FACTORS[1]:
        raise Failure(
            ExitCode.USAGE,
            f"--realtime-factor {factor:g}: give {FACTORS[0]:g} to {FACTORS[1]:g}; 1 is real time",
        )


def key_home() -> Path:
    """Where all machines' folders of keys are."""
    home = os.environ.get("XDG_CONFIG_HOME")
    base = Path(home) if home else Path.home() / ".config"
    return base / "headway" / "keys"


def key_folder(config: Config, named: Path | None) -> Path:
    """Where the keys of a machine are."""
    return named or key_home() / config.name


def machine_keys(config: Config, path: Path, named: Path | None) -> Keys:
    """The keys of the machine that `path` is the config of. Raises Failure."""
    from headway.devices.keys import KeyFileError, read_keys

    folder = key_folder(config, named)
    try:
        return read_keys(folder, [axis.joint for axis in config.machine.boards])
    except KeyFileError as error:
        hint = f"; `headway keys {path}` draws those that are missing"
        raise Failure(ExitCode.USAGE, f"{error}{hint}") from error


def place_folder(named: Path | None) -> Path:
    """Where plants leave their ports. Raises Failure."""
    from headway.devices.places import default_folder, own_folder
    from headway.devices.port import PortError

    folder = named or default_folder()
    try:
        own_folder(folder)
    except PortError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    return folder


def operating_system_rng() -> np.random.Generator:
    """Random numbers that nobody can foresee."""
    import numpy

    return numpy.random.default_rng(int.from_bytes(os.urandom(32), "little"))


def find_ports(
    keys: Keys,
    open_all: Callable[[], tuple[list[Port], list[str]]],
    rng: np.random.Generator,
    patience_s: float,
    alive: Callable[[], bool],
) -> list[Port]:
    """The port of each device, in the order of the keys.

    Raises Failure with what was found at each port, if a device does not answer.
    """
    found, said = find_devices(keys, open_all, rng, patience_s, alive)
    if said:
        for port in found.values():
            port.close()
        raise Failure(ExitCode.DEVICE, said)
    return [found[name] for name in keys.devices]


def find_devices(
    keys: Keys,
    open_all: Callable[[], tuple[list[Port], list[str]]],
    rng: np.random.Generator,
    patience_s: float,
    alive: Callable[[], bool],
) -> tuple[dict[str, Port], str]:
    """The ports of the devices that answer, by name; and what was found at each port, if not all
    do. Opens all ports anew until all have answered: a plant may just be starting."""
    from headway.devices.discovery import Search

    end_s = time.monotonic() + patience_s
    while True:
        ports, failed = open_all()
        search = Search(ports, keys.devices, rng)
        if ports:
            search_for(search, ROUND_S, lambda each: each.missing)
        if not search.missing or time.monotonic() > end_s or not alive():
            search.close_others()
            said = _not_found(search.missing, search.verdicts, failed) if search.missing else ""
            return search.found, said
        for port in ports:
            port.close()
        time.sleep(0.1)


def search_for(search: Search, seconds: float, left: Callable[[Search], object]) -> None:
    """Asks and listens, until nothing is left or the time is over."""
    next_s, end_s = 0.0, time.monotonic() + seconds
    while left(search) and time.monotonic() < end_s:
        if time.monotonic() >= next_s:
            search.ask()
            next_s = time.monotonic() + ASK_S
        search.listen()
        time.sleep(LOOK_S)


def _not_found(missing: Sequence[str], verdicts: dict[str, str], failed: Sequence[str]) -> str:
    lines = [f"{', '.join(missing)}: no device with this key answers at any port"]
    lines += [f"  {port}: {verdict}" for port, verdict in verdicts.items()]
    lines += [f"  {reason}" for reason in failed]
    if len(lines) == 1:
        lines.append("  there is no port to ask: is `headway plant` running, or a board connected?")
    return "\n".join(lines)


def _ephemeral(folder: Path, config: Config) -> Keys:
    from headway.devices.keys import draw_keys, read_keys

    names = [axis.joint for axis in config.machine.boards]
    draw_keys(folder, names)
    return read_keys(folder, names)


@contextmanager
def _spawned(
    linked: Linked, path: Path, changes: Sequence[str], home: Path, record: Path | None
) -> Iterator[subprocess.Popen[bytes]]:
    """A plant of our own. It ends with us, however we end."""
    words = ["plant", str(path), "--link", linked.kind, "--realtime-factor", str(linked.factor)]
    words += ["--keys", str(home / SCRATCH_KEYS), "--ports", str(home / SCRATCH_PORTS)]
    words += ["--until-eof", "--scratch", str(home)]
    words += [] if record is None else ["--record", str(record)]
    words += [word for change in changes for word in ("--set", change)]
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the loop, which the plant outlives
    )
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
