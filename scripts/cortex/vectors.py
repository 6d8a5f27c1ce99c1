"""The published vectors on a Cortex-M0 under qemu: the judge and the firmware, cross-compiled.

vectors.py [NAME ...]: all files of tests/vectors, or those named. Exits 0 if the firmware's answers
are the published ones, byte for byte; else 1, with the first that is not.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from tools import CORE, HERE, PREFIX, ROOT, need

sys.path.insert(0, str(ROOT / "scripts" / "vectors"))
from judge import compile_judge

VECTORS = ROOT / "tests" / "vectors"
# The only board of qemu's with a core of the smallest kind, ARMv6-M; with more memory than it has.
MACHINE = ("-M", "microbit", "-display", "none", "-monitor", "none", "-serial", "none")
MEMORY = ("-global", "nrf51-soc.flash-size=0x400000", "-global", "nrf51-soc.sram-size=0x400000")
LIMIT_S = 120


def compile_image(program: Path) -> Path:
    """The judge as an image that qemu starts."""
    linked = ("-specs=rdimon.specs", "-T", str(HERE / "memory.ld"), str(HERE / "start.c"))
    return compile_judge(program, CORE, PREFIX, linked)


def replay(image: Path, vectors: Path) -> tuple[int, str]:
    """The judge's exit code and words on one file; a command line of more would not fit."""
    words = f"enable=on,target=native,arg=judge,arg={vectors.name}"
    command = ["qemu-system-arm", *MACHINE, *MEMORY, "-semihosting-config", words]
    done = subprocess.run(
        [*command, "-kernel", image],
        cwd=vectors.parent,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    return done.returncode, done.stdout + done.stderr


def main(names: list[str]) -> int:
    """Replays the files."""
    need(f"{PREFIX}gcc", "qemu-system-arm")
    files = [VECTORS / f"{name}.txt" for name in names] or sorted(VECTORS.glob("*.txt"))
    with tempfile.TemporaryDirectory() as folder:
        image = compile_image(Path(folder) / "judge.elf")
        for file in files:
            code, said = replay(image, file)
            print(f"{file.name}: {'the same' if code == 0 else said}", flush=True)
            if code != 0:
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
