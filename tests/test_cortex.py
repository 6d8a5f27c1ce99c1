"""The firmware on a Cortex-M0, under qemu: the vectors give the same bytes as on the host."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from scripted import load_script

ROOT = Path(__file__).resolve().parents[1]
VECTORS = ROOT / "tests" / "vectors"


tools, vectors = load_script("cortex/tools"), load_script("cortex/vectors")


def require(*names: str) -> None:
    """Skips where the tools are missing; on the build server fails."""
    command = tools.missing(names)
    if command and os.environ.get("HEADWAY_CI"):
        pytest.fail(command)
    if command:
        pytest.skip(command)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    require("arm-none-eabi-gcc", "qemu-system-arm")
    made: Path = vectors.compile_image(tmp_path_factory.mktemp("cortex") / "judge.elf")
    return made


@pytest.mark.parametrize("path", sorted(VECTORS.glob("*.txt")), ids=lambda p: p.stem)
def test_the_vectors_give_the_same_bytes(image: Path, path: Path) -> None:
    code, said = vectors.replay(image, path)
    assert code == 0, said


def test_another_answer_is_noticed(image: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.txt"
    wrong.write_text("fixed-sum a=1 b=2 -> sum=3 difference=-1\nfixed-sum a=1 b=2 -> sum=4\n")
    code, said = vectors.replay(image, wrong)
    assert code == 1
    assert said.startswith("wrong.txt:2:") and "firmware:  sum=3 difference=-1" in said


def test_what_this_core_cannot_do_ends_the_program(tmp_path: Path) -> None:
    """A misaligned access works on the host; here it is a fault, and no hang."""
    require("arm-none-eabi-gcc", "qemu-system-arm")
    source, program = tmp_path / "odd.c", tmp_path / "odd.elf"
    source.write_text("int main(int argc, char **argv) { return *(volatile int *)(*argv + argc); }")
    here = ROOT / "scripts" / "cortex"
    linked = ["-specs=rdimon.specs", "-T", here / "memory.ld", here / "start.c", "-o", program]
    subprocess.run([f"{tools.PREFIX}gcc", *tools.CORE, source, *linked], check=True)
    code, _ = vectors.replay(program, tmp_path / "none.txt")
    assert code == 70


@pytest.mark.parametrize(
    ("there", "asked"),
    [
        ([], "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"),
        (["arm-none-eabi-gcc"], "qemu-system-arm"),
    ],
)
def test_what_is_missing_is_one_command(tmp_path: Path, there: list[str], asked: str) -> None:
    for tool in there:
        (tmp_path / tool).symlink_to(shutil.which("true") or "/bin/true")
    command = [sys.executable, ROOT / "scripts" / "cortex" / "vectors.py"]
    done = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"headway: please run: sudo apt-get install -y {asked}\n"
