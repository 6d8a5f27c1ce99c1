"""The cross compiler for a Cortex-M0+, and what to do where it is missing."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
PREFIX = "arm-none-eabi-"
CORE = ("-mcpu=cortex-m0plus", "-mthumb", "-O2")
PACKAGES = {  # of Debian
    f"{PREFIX}gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}


def missing(tools: Iterable[str]) -> str:
    """The one command that brings what is not there; "" if all is."""
    packages = [PACKAGES[tool] for tool in tools if not shutil.which(tool)]
    return f"please run: sudo apt-get install -y {' '.join(packages)}" if packages else ""


def need(*tools: str) -> None:
    """Ends the program with that command if one is missing."""
    if command := missing(tools):
        print(f"headway: {command}", file=sys.stderr)
        raise SystemExit(2)
