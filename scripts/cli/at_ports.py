"""Devices at ports that the command line names, of machines whose configs nobody needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import PATIENCE_S, key_home, operating_system_rng, search_for
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.devices.discovery import Search
    from headway.devices.port import Port
    from headway.devices.port_link import PortLink
    from headway.devices.remote import Remote

KNOT_US = 4096  # between frames: what a config has by default


@dataclass(frozen=True)
class AtPorts:
    """By device: its name, its port's, and what is known of it; and the link to all."""

    names: list[str]
    ports: list[str]
    remotes: list[Remote]
    link: PortLink


def readable_keys(named: Path | None) -> dict[str, bytes]:
    """Devices' keys of one folder, by their names, or of all machines, by MACHINE/NAME. Raises
    Failure."""
    from headway.devices.keys import SYNC, KeyFileError, read_key

    home = named or key_home()
    found = {}
    try:
        for path in sorted(home.glob("*.key" if named else "*/*.key")):
            if path.stem != SYNC:
                name = path.relative_to(home).with_suffix("")
                found[str(name)] = read_key(path.parent, path.stem)
    except KeyFileError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    if not found:
        raise Failure(
            ExitCode.USAGE,
            f"{home}: there is no device's key, and a device tells its time to nobody without: "
            "name the machine's folder with --keys",
        )
    return found


@contextmanager
def at_ports(places: Sequence[str], named: Path | None, clock: WallClock) -> Iterator[AtPorts]:
    """Opens all of these ports and finds out whose they are, by the keys in `named`, or in all
    folders. Raises Failure, with what there is at each port where no device was found."""
    from headway.devices.core import COAST_KNOTS
    from headway.devices.discovery import Search
    from headway.devices.places import open_place
    from headway.devices.port import PortError
    from headway.devices.port_link import PortLink
    from headway.devices.remote import Remote
    from headway.devices.session import Session

    keys, rng = readable_keys(named), operating_system_rng()
    with ExitStack() as stack:
        ports: list[Port] = []
        for place in dict.fromkeys(places):
            try:
                ports.append(open_place(place))
            except PortError as error:
                raise Failure(ExitCode.DEVICE, str(error)) from error
            stack.callback(ports[-1].close)
        search = Search(ports, keys, rng)
        search_for(search, PATIENCE_S, lambda each: each.silent)
        if search.silent:
            raise Failure(ExitCode.DEVICE, "\n".join(_why(search, port) for port in search.silent))
        names = [next(n for n, found in search.found.items() if found is port) for port in ports]
        patience_us = COAST_KNOTS * KNOT_US
        remotes = [Remote(Session(keys[name], rng), patience_us, i) for i, name in enumerate(names)]
        stack.pop_all()  # from here on the link closes them
        link = PortLink(ports, clock.now_us)
        try:
            yield AtPorts(names, link.names, remotes, link)
        finally:
            link.close()


def _why(search: Search, port: Port) -> str:
    verdict = search.verdicts.get(port.name, "no answer")
    if verdict == "wrong key":
        verdict = "there is a device, of which no key is here: name its machine's with --keys"
    return f"{port.name}: {verdict}"
