"""scripts/setup on a machine where something is missing: says what to install, does nothing."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

TOOLS = ["bash", "env", "dirname", "readlink"]  # any machine has them


class Machine:
    """A copy of the scripts, and a PATH that holds only what a test put there."""

    def __init__(self, directory: Path) -> None:
        self.bin = directory / "bin"
        self.checkout = directory / "check out"
        self.bin.mkdir()
        for tool in TOOLS:
            self.link(tool)
        shutil.copytree(ROOT / "scripts", self.checkout / "scripts")
        for name in ("pyproject.toml", "requirements.lock", "CMakeLists.txt"):
            shutil.copy(ROOT / name, self.checkout)

    def link(self, tool: str) -> None:
        found = shutil.which(tool)
        assert found, tool
        (self.bin / tool).symlink_to(found)

    def script(self, name: str, body: str) -> None:
        file = self.bin / name
        file.write_text(f"#!{self.bin}/bash\n{body}\n")
        file.chmod(0o755)

    def python(self, name: str = "python3", without: str = "") -> None:
        """This very Python under `name`, in which the module `without` cannot be imported."""
        hidden = self.bin.parent / f"hidden-{name}"
        hidden.mkdir()
        if without:
            (hidden / f"{without}.py").write_text(f"raise ImportError('no {without}')\n")
        self.script(
            name, f'PYTHONDONTWRITEBYTECODE=1 PYTHONPATH="{hidden}" exec "{sys.executable}" "$@"'
        )

    def old_python(self, name: str = "python3") -> None:
        self.script(name, "exit 1")

    def compilers(self) -> None:
        self.script("cc", "exit 0")
        self.script("c++", "exit 0")

    def files(self) -> set[Path]:
        return set(self.checkout.rglob("*"))

    def packages_asked_for(self, script: str = "setup") -> list[str]:
        """Runs a script that must refuse; returns the packages in the one line it prints."""
        before = self.files()
        run = subprocess.run(
            [self.checkout / "scripts" / script],
            env={"PATH": str(self.bin)},
            cwd=self.bin,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert (run.returncode, run.stdout) == (2, ""), run.stderr
        assert run.stderr.count("\n") == 1, run.stderr
        _, command, packages = run.stderr.partition("sudo apt-get install -y ")
        assert command, run.stderr
        assert self.files() == before
        return packages.split()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_nothing_there(machine: Machine) -> None:
    assert machine.packages_asked_for() == [
        "python3",
        "python3-venv",
        "python3-dev",
        "gcc",
        "g++",
    ]


def test_no_compilers(machine: Machine) -> None:
    machine.python()
    assert machine.packages_asked_for() == ["gcc", "g++"]


def test_only_a_c_compiler(machine: Machine) -> None:
    machine.python()
    machine.script("gcc", "exit 0")
    assert machine.packages_asked_for() == ["g++"]


@pytest.mark.parametrize("module", ["venv", "ensurepip"])
def test_no_venv(machine: Machine, module: str) -> None:
    machine.python(without=module)
    machine.compilers()
    assert machine.packages_asked_for() == ["python3-venv"]


def test_no_venv_and_no_compilers(machine: Machine) -> None:
    machine.python(without="ensurepip")
    assert machine.packages_asked_for() == ["python3-venv", "gcc", "g++"]


def test_old_python(machine: Machine) -> None:
    machine.old_python()
    machine.compilers()
    assert machine.packages_asked_for() == ["python3.11", "python3.11-venv", "python3.11-dev"]


def test_newer_python_beside_an_old_one(machine: Machine) -> None:
    machine.old_python()
    machine.python("python3.12", without="ensurepip")
    machine.compilers()
    assert machine.packages_asked_for() == ["python3.12-venv"]


@pytest.mark.parametrize("script", ["run", "test", "headway", "bench"])
def test_every_entry_point_refuses_alike(machine: Machine, script: str) -> None:
    machine.python()
    assert machine.packages_asked_for(script) == ["gcc", "g++"]
