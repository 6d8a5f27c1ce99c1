"""The bar while a machine's model is compiled for the first time."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from headway.cli.progress import compiling, libraries
from headway.configs.load import load_config
from headway.models.codegen import compile_source

ROOT = Path(__file__).resolve().parent.parent
ARM2 = ROOT / "configs" / "arm2.yaml"
COMMAND = Path(sys.executable).with_name("headway")
COUNT = re.compile(r"(\d+)/(\d+)")


@pytest.fixture(autouse=True)
def _anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing has been compiled yet, and what is takes no optimizer."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("TERM", "xterm")
    for variable, compiler in (("CC", "cc"), ("CXX", "c++")):
        quick = tmp_path / f"quick-{compiler}"
        quick.write_text(f'#!/bin/sh\nexec {compiler} "$@" -O0\n')
        quick.chmod(0o755)
        monkeypatch.setenv(variable, str(quick))
    monkeypatch.chdir(tmp_path)


class Terminal:
    """What standard error is on a terminal, and what has been written there."""

    def __init__(self) -> None:
        self._inner, self.end = os.openpty()
        os.set_blocking(self._inner, False)
        self._said = b""

    def drain(self) -> None:
        """Takes what there is, so that nobody waits for room."""
        try:
            while chunk := os.read(self._inner, 65536):
                self._said += chunk
        except OSError:
            pass

    @property
    def said(self) -> str:
        self.drain()
        return self._said.decode()


def run(stderr: int, *more: str) -> "subprocess.Popen[str]":
    command = [str(COMMAND), "run", str(ARM2), "--duration=0.1", "--json", *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True)


@pytest.mark.parametrize("backend", ["osqp", "riccati"])
def test_on_a_terminal_it_counts_all_there_is_to_compile(backend: str) -> None:
    terminal = Terminal()
    process = run(terminal.end, f"--set=mpc.backend={backend}")
    while process.poll() is None:
        try:
            process.wait(0.1)
        except subprocess.TimeoutExpired:
            terminal.drain()
    assert process.stdout is not None
    assert json.loads(process.stdout.read())["config"] == "arm2"
    assert process.returncode == 0, terminal.said
    said = terminal.said
    assert "compiling machine, once" in said and "(once) ..." not in said
    counts = [(int(done), int(total)) for done, total in COUNT.findall(said)]
    total = libraries(load_config(ARM2, [f"mpc.backend={backend}"]))
    assert counts[0] == (0, total) and counts[-1] == (total, total)
    assert counts == sorted(counts)
    again = run(terminal.end, f"--set=mpc.backend={backend}")
    out, _ = again.communicate(timeout=60)
    assert json.loads(out)["config"] == "arm2"
    assert "compiling" not in terminal.said.removeprefix(said)


def test_into_a_pipe_there_are_lines() -> None:
    out, err = run(subprocess.PIPE).communicate(timeout=100)
    assert json.loads(out)["config"] == "arm2"
    names = re.findall(r"^compiling (\w+) \(once\) \.\.\.$", err, re.MULTILINE)
    assert len(names) == libraries(load_config(ARM2))
    assert not COUNT.search(err) and "\x1b" not in err


def test_it_goes_away_when_a_compiler_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And lines are back afterwards."""
    terminal = Terminal()
    with monkeypatch.context() as patched, os.fdopen(os.dup(terminal.end), "w") as stream:
        patched.setattr(sys, "stderr", stream)
        with pytest.raises(RuntimeError, match="failed"), compiling(load_config(ARM2)):
            compile_source("broken", "int broken(")
    assert "compiling broken, once" in terminal.said
    assert terminal.said.rstrip().endswith(("\x1b[?25h", "\x1b[2K"))  # the cursor is back
    compile_source("whole", "int whole;\n")
    assert "compiling whole (once) ..." in capsys.readouterr().err
