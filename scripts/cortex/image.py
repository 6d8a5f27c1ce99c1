"""The firmware as an image for the emulator, and what the compiler brought along."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

from tools import CORE, HERE, PREFIX, ROOT

# As the host lays structs out: then a device's state is the same bytes here and there.
LAYOUT = "-fno-short-enums"
# As one unit: what is called once a period is no call. Of what it inlines there, the compiler
# does not see that all is set.
WHOLE = (
    "-flto=1", "-flto-partition=none", "-fno-reorder-blocks", "-Wno-maybe-uninitialized",
    "-ffixed-r8", "-ffixed-r9", "-ffixed-r10", "-ffixed-r11",
)  # fmt: skip
SOFT_FLOAT = ("__aeabi_f", "__aeabi_d", "__aeabi_cf", "__aeabi_cd", "__aeabi_i2", "__aeabi_ui2")
SOFT_FLOAT += ("__aeabi_l2", "__aeabi_ul2")


def compile_firmware(
    program: Path, more: Iterable[Path] = (), options: Iterable[str] = (), root: Path = ROOT
) -> Path:
    """All of firmware/ with board.c and `more` sources; `options` are for the firmware alone."""
    sources = sorted((root / "firmware").glob("*.c"))
    flags = ["-std=c11", "-g", "-Wall", "-Wextra", "-Werror", *CORE, LAYOUT]
    flags += [f"-I{root / 'firmware'}"]
    boards = []
    for source in (HERE / "board.c", *more):  # a board's own, compiled apart: guard.h counts on it
        boards.append(program.with_suffix(f".{source.stem}.o"))
        subprocess.run([f"{PREFIX}gcc", *flags, "-c", source, "-o", boards[-1]], check=True)
    flags += [*options, "-nostartfiles", "-Wl,-e,the_poll,--no-enum-size-warning"]
    linked = ["-T", HERE / "memory.ld", *sources, *boards, "-o", program]
    subprocess.run([f"{PREFIX}gcc", *flags, *linked], check=True)
    return program


def soft_float(names: Iterable[str]) -> list[str]:
    """Of an image's symbols, the compiler's routines for floating point."""
    return sorted(n for n in names if n.startswith(SOFT_FLOAT) and not n.startswith("__aeabi_dr"))
