"""Where cycles go: by function and by line of source, inlined ones where they are written."""

from __future__ import annotations

import subprocess
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from emulator import Emulator, Tally
from tools import PREFIX, ROOT

Place = tuple[str, str]  # function, and file:line
CALLERS = ("the_poll", "device_poll", "run_period", "drive", "find_setpoint")  # of a tick's parts


def places(file: Path, addresses: Iterable[int]) -> dict[int, list[Place]]:
    """Of each address, innermost first, what it was inlined into; the image has to be of -g."""
    wanted = sorted(set(addresses))
    command = [f"{PREFIX}addr2line", "-e", str(file), "-a", "-f", "-i"]
    said = subprocess.run(
        command, input="\n".join(map(hex, wanted)), check=True, capture_output=True, text=True
    ).stdout.splitlines()
    found: dict[int, list[Place]] = {}
    chain: list[Place] = []
    lines = iter(said)
    for line in lines:
        if line.startswith("0x"):
            chain = found[int(line, 16)] = []
        else:
            where = next(lines).partition(" (")[0].replace(f"{ROOT}/", "")
            chain.append((line, where))
    return found


def label(chain: list[Place], by: str) -> str:
    """Of an address: by "line"; by "function", the one it is written in; by "part", the outermost
    one that does work of its own."""
    function, where = chain[0]
    if by == "part":
        return next((name for name, _ in reversed(chain) if name not in CALLERS), function)
    return function if by == "function" else f"{where} {function}"


def profile(core: Emulator, file: Path, tallies: list[Tally], by: str) -> list[dict[str, Any]]:
    """Mean cycles of the tallies by "part", "function" or "line", most first."""
    blocks: Counter[tuple[int, int]] = Counter()
    for tally in tallies:
        blocks.update(tally.blocks)
    costs: Counter[int] = Counter()
    for (address, size), times in blocks.items():
        for at, cycles in core.price(address, size):
            costs[at] += cycles * times
    shares: Counter[str] = Counter()
    chains = places(file, costs)
    for at, cycles in costs.items():
        shares[label(chains[at], by)] += cycles
    return [{by: name, "cycles": cycles / len(tallies)} for name, cycles in shares.most_common()]
