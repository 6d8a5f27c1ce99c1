"""scripts/fuzz: the targets live, reach what they are about, and find a bug that is planted."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from scripted import load_script

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "scripts" / "fuzzing"
SECONDS = 15  # a target
HUNT_S = 60  # for a planted bug, at most
# In a file of firmware/, what a target has to find: (target, file, code, wrong code).
BUGS = (
    ("plans", "gate.c", "if (d2 > limits->second_difference_max ||", "if ("),
    (
        "graphs",
        "graph.c",
        "return source >= SOURCE_OF_NODES + at ?",
        "return source > SOURCE_OF_NODES + at ?",
    ),
    (
        "graphs",
        "signals.c",
        "signals->told[output] = number;",
        "signals->told[output] = number + 1;",
    ),
    ("bytes", "cobs.c", "read + length - 1 > size", "read + length - 2 > size"),
)


@pytest.fixture(scope="module")
def fuzzing() -> Iterator[dict[str, ModuleType]]:
    """The tool's modules by name. Skips without clang; on the build server fails."""
    main = load_script("fuzzing/__main__")
    modules = {"main": main, "build": sys.modules["build"], "seeds": sys.modules["seeds"]}
    command = modules["build"].missing()
    if command and os.environ.get("HEADWAY_CI"):
        pytest.fail(command)
    if command:
        pytest.skip(command)
    yield modules
    for name in ("build", "seeds"):
        del sys.modules[name]


def test_nothing_crashes_and_most_is_reached(
    fuzzing: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main = fuzzing["main"]
    for target, files in main.REACHED.items():
        assert main.fuzz(target, SECONDS, tmp_path), capsys.readouterr().out
        inputs = sorted((tmp_path / f"{target}-corpus").iterdir())
        found = fuzzing["build"].coverage(target, inputs, files)
        assert [file.file for file in found if file.ran == 0] == []
        # By chance a little less than what a longer run reaches, main.GOAL.
        assert sum(file.ran for file in found) > 0.9 * sum(file.all for file in found), found


@pytest.mark.parametrize(("target", "name", "code", "wrong"), BUGS)
def test_a_planted_bug_is_found(
    fuzzing: dict[str, ModuleType], tmp_path: Path, target: str, name: str, code: str, wrong: str
) -> None:
    for folder in ("firmware", "sim", "tests/fuzz"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    file = tmp_path / "firmware" / name
    assert file.read_text().count(code) == 1
    file.write_text(file.read_text().replace(code, wrong))
    program = fuzzing["build"].fuzzer(target, tmp_path / target, tmp_path)
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    if target == "bytes":
        fuzzing["seeds"].write(corpus, fuzzing["seeds"].of_vectors(ROOT / "tests" / "vectors"))
    options = [f"-max_total_time={HUNT_S}", "-max_len=2000", f"-artifact_prefix={tmp_path}/"]
    done = subprocess.run([program, *options, corpus], capture_output=True, text=True)
    assert done.returncode != 0, "not found"
    assert "not so" in done.stderr or "Sanitizer" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "usage: scripts/fuzz SECONDS"),
        (["soon"], "usage: scripts/fuzz SECONDS"),
        (["5", "gate"], "no target called gate; there are: bytes, plans, graphs"),
    ],
)
def test_mistakes(words: list[str], message: str) -> None:
    done = subprocess.run([sys.executable, FOLDER, *words], capture_output=True, text=True)
    assert done.returncode == 2 and message in done.stderr and "Traceback" not in done.stderr


def test_without_clang_it_says_what_to_install(tmp_path: Path) -> None:
    command = [sys.executable, FOLDER, "5"]
    done = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "headway: please run: sudo apt-get install -y clang libclang-rt-dev\n"
