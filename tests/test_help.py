"""Help that teaches by example and comes at once, and the completion of commands in shells."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from headway.cli.main import main, make_app

COMMANDS = [name for name in make_app() if not name.startswith("-")]
LEAVES = [
    [name, *more]
    for name in COMMANDS
    for more in [[sub] for sub in make_app()[name] if not sub.startswith("-")] or [[]]
]
HEAVY = {
    "casadi", "filterpy", "glfw", "google.protobuf", "mcap", "mujoco", "numpy", "osqp", "PIL",
    "pinocchio", "pyarrow", "pydantic", "ruamel.yaml", "scipy",
}  # fmt: skip


@pytest.mark.parametrize("words", [*LEAVES, ["devices"]], ids=" ".join)
def test_every_command_has_an_example(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    command = " ".join(words)
    assert main([*words, "--help"]) == 0
    out, err = capsys.readouterr()
    text = " ".join(out.split())
    assert err == ""
    assert "Example: " in text
    assert f" headway {command} " in text.partition("Example: ")[2]
    assert "Exit codes: 0 done" in text


@pytest.mark.parametrize("arguments", [["--help"], ["sweep", "--help"], ["completion", "bash"]])
def test_help_imports_nothing_that_takes_time(arguments: list[str]) -> None:
    script = (
        "import sys\n"
        "from headway.cli.main import main\n"
        f"main({arguments!r})\n"
        f"print(sorted({HEAVY!r} & set(sys.modules)), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stderr == "[]\n"


@pytest.fixture(scope="module")
def bash(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script, and a folder to complete names in."""
    folder = tmp_path_factory.mktemp("bash")
    command = Path(sys.executable).with_name("headway")
    done = subprocess.run([command, "completion", "bash"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    (folder / "script").write_text(done.stdout)
    (folder / "configs").mkdir()
    (folder / "configs" / "my arm.yaml").touch()
    return folder


def completed(folder: Path, *words: str) -> list[str]:
    """What bash would offer for the last of the words."""
    script = (
        'source ./script; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _headway; '
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", script, "bash", "headway", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def test_bash_reads_the_script(bash: Path) -> None:
    subprocess.run(["bash", "-n", "script"], cwd=bash, check=True)
    ask = "source ./script; complete -p headway"
    done = subprocess.run(["bash", "-c", ask], cwd=bash, capture_output=True, text=True)
    assert done.stdout == "complete -o filenames -F _headway headway\n"


def test_bash_completes_commands(bash: Path) -> None:
    assert completed(bash, "") == COMMANDS
    assert completed(bash, "sw") == ["sweep"]
    assert completed(bash, "completion", "") == ["bash", "zsh", "fish"]


@pytest.mark.parametrize("words", LEAVES, ids=" ".join)
def test_bash_completes_options(bash: Path, words: list[str]) -> None:
    command = make_app()
    for word in words:
        command = command[word]
    arguments = command.assemble_argument_collection()
    options = {name for argument in arguments for name in argument.names if name[:2] == "--"}
    assert options <= set(completed(bash, *words, "--"))
    assert completed(bash, "run", "a.yaml", "--dur") == ["--duration"]


def test_bash_completes_files(bash: Path) -> None:
    assert completed(bash, "run", "conf") == ["configs"]
    assert completed(bash, "run", "a.yaml", "--out", "conf") == ["configs"]
    assert completed(bash, "run", "a.yaml", "--seed", "") == [""]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(word in script for word in [*COMMANDS, "vary", "headway"])
    if found := shutil.which(shell):
        subprocess.run([found, "-n"], input=script, text=True, check=True)


def test_no_such_shell(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "csh"]) == 2
    assert "bash" in capsys.readouterr().err
