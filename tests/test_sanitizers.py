"""The firmware and the simulated board under the address and undefined-behaviour sanitizers."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
OPTIONS = {"ASAN_OPTIONS": "detect_leaks=0", "UBSAN_OPTIONS": "print_stacktrace=1"}


WRAPPED = ["board_set_power", "board_set_duty", "board_set_brake", "board_supply_mV"]


def compile_and_run(
    sources: list[Path], into: Path, *options: str
) -> subprocess.CompletedProcess[str]:
    compiler = shutil.which("cc")
    assert compiler, "no C compiler: install cc (gcc or clang)"
    program = into / "harness"
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-O1", "-g", *SANITIZE]
    includes = [f"-I{ROOT / folder}" for folder in ("sim", "firmware")]
    command = [compiler, *flags, *options, *includes, *map(str, sources), "-o", str(program)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, f"cc cannot build with {SANITIZE[0]}:\n{built.stderr}"
    return subprocess.run(
        [str(program)], capture_output=True, text=True, timeout=300, env=os.environ | OPTIONS
    )


def test_nothing_that_arrives_is_undefined(tmp_path: Path) -> None:
    sources = sorted((ROOT / "firmware").glob("*.c"))
    assert len(sources) > 8
    harness = Path(__file__).with_name("sanitize_harness.c")
    board = [ROOT / "sim" / name for name in ("board.c", "oscillator.c")]
    wraps = [f"-Wl,--wrap={name}" for name in WRAPPED]
    ran = compile_and_run([*sources, *board, harness], tmp_path, *wraps)
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("fault", "report"),
    [
        ("volatile int x = 2147483647; x += argc;", "signed integer overflow"),
        ("volatile char *p = malloc(4 * argc); p[4 * argc] = 1;", "heap-buffer-overflow"),
        ("volatile int x = -argc; x = x << 3;", "left shift of negative"),
    ],
)
def test_a_fault_is_seen(tmp_path: Path, fault: str, report: str) -> None:
    """The compiler at hand does stop what the test above relies on it to stop."""
    source = tmp_path / "fault.c"
    main = "int main(int argc, char **argv)"
    source.write_text(f"#include <stdlib.h>\n{main} {{ (void)argv; {fault} return 0; }}\n")
    ran = compile_and_run([source], tmp_path)
    assert ran.returncode != 0
    assert report in ran.stderr
