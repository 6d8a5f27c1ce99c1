"""What the commands that reach real devices share: their keys, their ports, their factor."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from headway.cli.failure import ExitCode, Failure
from headway.cli.wall import FACTORS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np

    from headway.configs.schema import Config
    from headway.devices.keys import Keys
    from headway.devices.port import Port

Kind = Literal["serial", "udp"]
Factor = Annotated[float, Parameter(name="--realtime-factor")]
PATIENCE_S = 10.0  # until every device has to have answered
ASK_S, LOOK_S = 0.2, 0.01


def check_factor(factor: float) -> None:
    """Raises Failure."""
    if not FACTORS[0] <= factor <= FACTORS[1]:
        raise Failure(
            ExitCode.USAGE,
            f"--realtime-factor {factor:g}: give {FACTORS[0]:g} to {FACTORS[1]:g}; 1 is real time",
        )


def key_folder(config: Config, named: Path | None) -> Path:
    """Where the keys of a machine are."""
    home = os.environ.get("XDG_CONFIG_HOME")
    base = Path(home) if home else Path.home() / ".config"
    return named or base / "headway" / "keys" / config.name


def machine_keys(config: Config, path: Path, named: Path | None) -> Keys:
    """The keys of the machine that `path` is the config of. Raises Failure."""
    from headway.devices.keys import KeyFileError, read_keys

    folder = key_folder(config, named)
    try:
        return read_keys(folder, [axis.joint for axis in config.machine.axes])
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
    alive: Callable[[], bool] = lambda: True,
    patience_s: float = PATIENCE_S,
) -> list[Port]:
    """The port of each device, in the order of the keys.

    Opens all ports anew until every device has answered: a plant may just be starting. Raises
    Failure with what was found at each port, if one does not.
    """
    from headway.devices.discovery import Search

    end_s = time.monotonic() + patience_s
    while True:
        ports, failed = open_all()
        search = Search(ports, keys.devices, rng)
        next_s = 0.0
        round_s = time.monotonic() + 2.0
        while search.missing and ports and time.monotonic() < round_s:
            if time.monotonic() >= next_s:
                search.ask()
                next_s = time.monotonic() + ASK_S
            search.listen()
            time.sleep(LOOK_S)
        if not search.missing:
            search.close_others()
            return [search.found[name] for name in keys.devices]
        for port in ports:
            port.close()
        if time.monotonic() > end_s or not alive():
            raise Failure(ExitCode.DEVICE, _not_found(search.missing, search.verdicts, failed))
        time.sleep(0.1)


def _not_found(missing: Sequence[str], verdicts: dict[str, str], failed: Sequence[str]) -> str:
    lines = [f"{', '.join(missing)}: no device with this key answers at any port"]
    lines += [f"  {port}: {verdict}" for port, verdict in verdicts.items()]
    lines += [f"  {reason}" for reason in failed]
    if len(lines) == 1:
        lines.append("  there is no port to ask: is `headway plant` running, or a board connected?")
    return "\n".join(lines)
