"""The firmware as an image for the emulator, and what the compiler brought along."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

from tools import CORE, HERE, PREFIX, ROOT

# As the host lays structs out: then a device's state is the same bytes here and there.
LAYOUT = "-fno-short-enums"
SOFT_FLOAT = ("__aeabi_f", "__aeabi_d", "__aeabi_cf", "__aeabi_cd", "__aeabi_i2", "__aeabi_ui2")
SOFT_FLOAT += ("__aeabi_l2", "__aeabi_ul2")


def compile_firmware(
    program: Path, more: Iterable[Path] = (), options: Iterable[str] = (), root: Path = ROOT
) -> Path:
    """All of firmware/ with board.c and `more` sources."""
    sources = [*sorted((root / "firmware").glob("*.c")), HERE / "board.c", *more]
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", *CORE, LAYOUT, *options]
    flags += [f"-I{root / 'firmware'}", "-nostartfiles", "-Wl,-e,the_poll,--no-enum-size-warning"]
    linked = ["-T", HERE / "memory.ld", *sources, "-o", program]
    subprocess.run([f"{PREFIX}gcc", *flags, *linked], check=True)
    return program


def soft_float(names: Iterable[str]) -> list[str]:
    """Of an image's symbols, the compiler's routines for floating point."""
    return sorted(n for n in names if n.startswith(SOFT_FLOAT) and not n.startswith("__aeabi_dr"))
