"""Every command in README.md and the other pages does what it did when it was written.

A command block is a fenced block marked `sh` or `bash`, or an indented one that begins with a
program we know. The blocks of a page run one after the other in a folder that looks like a
checkout; a block with `<!-- not run: REASON -->` before it is only held against the programs'
options. A fenced block with `<!-- file: PATH -->` before it is written to that file first.
"""

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from headway.cli.main import make_app

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("*.md", "docs/*.md", "models/*/README.md")
    for path in ROOT.glob(pattern)
)
PROGRAM = re.compile(
    r"(\.venv/bin/\w+|scripts/\w+|headway|git|python3?|pip|pytest|sudo|source|cd|mkdir|cp|echo)\s"
)
OTHERS = {"git", "cd", "sudo", "mkdir", "cp", "echo", "grep", "head", "tail", "cat", "source"}
MARK = re.compile(r"<!-- (not run|file): (.+) -->")
TIMEOUT_S = 300  # of a block that hangs


@dataclass
class Block:
    """Consecutive lines of a page that are set as code."""

    line: int  # of the page, from 1
    text: str
    language: str  # of a fenced block; "" for an indented one
    not_run: str = ""  # why
    file: str = ""  # that it is the content of

    @property
    def is_commands(self) -> bool:
        if self.language:
            return self.language in ("sh", "bash")
        return PROGRAM.match(self.text) is not None


def blocks(page: str) -> list[Block]:
    """All code of a page. Raises AssertionError for a mark without a block."""
    found: list[Block] = []
    lines = page.splitlines()
    mark: tuple[str, str] | None = None
    i = 0
    while i < len(lines):
        start, line = i, lines[i]
        i += 1
        language, code = "", list[str]()
        if line.startswith("```"):
            language = line[3:].strip() or "text"
            while not lines[i].startswith("```"):
                code.append(lines[i])
                i += 1
            i += 1
        elif line.startswith("    ") and (start == 0 or not lines[start - 1].strip()):
            i = start
            while i < len(lines) and (lines[i].startswith("    ") or not lines[i].strip()):
                code.append(lines[i][4:])
                i += 1
        if code:
            block = Block(start + 1, "\n".join(code).rstrip() + "\n", language)
            if mark:
                setattr(block, mark[0], mark[1])
                assert block.file or block.is_commands, (
                    f"line {block.line}: a mark without commands"
                )
            found.append(block)
            mark = None
        elif marked := MARK.fullmatch(line.strip()):
            mark = marked[1].replace(" ", "_"), marked[2]
        else:
            assert not mark or not line.strip(), f"line {start}: a mark without a block"
    return found


def simple_commands(text: str) -> list[list[str]]:
    """The words of each, without comments."""
    found = []
    for line in text.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;")
        command: list[str] = []
        for word in [*lexer, ";"]:
            if word.strip("|&;"):
                command.append(word)
            elif command:
                found.append(command)
                command = []
    return found


def check(words: list[str]) -> None:
    """Holds a command against what there is, without running it. Raises AssertionError."""
    program, *arguments = words
    name = program.removeprefix(".venv/bin/")
    if name == "headway" or program in ("scripts/headway", "scripts/run"):
        if program == "scripts/run":
            arguments = ["run", *arguments]
        check_options(arguments)
    elif name.startswith("python"):
        first = arguments[0]
        if first == "-m":
            assert importlib.util.find_spec(arguments[1]), words
        elif first != "-c":
            assert (ROOT / first).is_file(), words
    elif program.startswith("scripts/"):
        assert os.access(ROOT / program, os.X_OK), words
    else:
        assert name in OTHERS | {"pip", "pytest"}, words


def check_options(arguments: list[str]) -> None:
    """The command is there and has these options."""
    app, known = make_app(), {"--help", "--version"}
    if arguments and not arguments[0].startswith("-"):
        assert arguments[0] in app, f"there is no command {arguments[0]}"
        for argument in app[arguments[0]].assemble_argument_collection():
            known.update(argument.names)
    used = {word.partition("=")[0] for word in arguments if word.startswith("--")}
    assert used <= known, f"{arguments}: no {used - known}"


def checkout(folder: Path) -> None:
    """Makes a folder look like a checkout that is set up. Its scripts are the true ones but for
    `setup`, which must not build anything here."""
    for name in ("configs", "models"):
        ignored = shutil.ignore_patterns("*.py", "__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in (".venv", "docs", "README.md", "pyproject.toml"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "scripts").mkdir()
    for path in (ROOT / "scripts").iterdir():
        if path.is_dir() or path.suffix == ".py":
            (folder / "scripts" / path.name).symlink_to(path)
        elif path.name != "setup":
            shutil.copy(path, folder / "scripts")
    (folder / "scripts" / "setup").write_text(f"root={ROOT}\nvenv=$root/.venv\n")


def run(block: Block, folder: Path, page: str) -> None:
    path = f"{ROOT / '.venv' / 'bin'}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.text],
        cwd=folder,
        env={**os.environ, "PATH": path},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    where = f"{page}:{block.line}:\n{block.text}exit code {done.returncode}\n"
    assert done.returncode == 0, f"{where}{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


@pytest.mark.parametrize("page", PAGES)
def test_commands_of(page: str, tmp_path: Path) -> None:
    checkout(tmp_path)
    for block in blocks((ROOT / page).read_text(encoding="utf-8")):
        if block.file:
            (tmp_path / block.file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / block.file).write_text(block.text, encoding="utf-8")
        if block.is_commands:
            if block.not_run:
                for words in simple_commands(block.text):
                    check(words)
            else:
                run(block, tmp_path, page)


# --- the above, on pages of its own ------------------------------------------------------------

PAGE = """
# Title

    headway run configs/arm2.yaml --duration 2 | head  # a comment; it's nothing

    echo 'the same block' && false
Text that is code for nobody:

    a --- diagram
    headway in the middle

1. A list
    headway that is text

<!-- not run: it takes long -->

```sh
scripts/bench tracking --long; \\
cd /
```

<!-- file: a/b.py -->
```python
print("headway")
```

```
headway in no language
```
"""


def test_blocks() -> None:
    first, diagram, slow, file, plain = blocks(PAGE)
    assert (first.line, first.is_commands, first.not_run) == (4, True, "")
    assert first.text.splitlines()[1:] == ["", "echo 'the same block' && false"]
    assert not diagram.is_commands and not plain.is_commands
    assert (slow.is_commands, slow.not_run, slow.line) == (True, "it takes long", 17)
    assert (file.is_commands, file.file, file.text) == (False, "a/b.py", 'print("headway")\n')
    assert simple_commands(first.text) == [
        ["headway", "run", "configs/arm2.yaml", "--duration", "2"],
        ["head"],
        ["echo", "the same block"],
        ["false"],
    ]
    assert simple_commands(slow.text) == [["scripts/bench", "tracking", "--long"], ["cd", "/"]]


@pytest.mark.parametrize(
    "page", ["<!-- not run: why -->\n\ntext\n", "<!-- not run: why -->\n\n    just code\n"]
)
def test_a_mark_for_nothing(page: str) -> None:
    with pytest.raises(AssertionError, match="a mark without"):
        blocks(page)


@pytest.mark.parametrize(
    "command",
    [
        "headway run a.yaml --duration 2 --set a.b=1 --json",
        ".venv/bin/headway --help",
        "scripts/run --seed 3",
        "scripts/test",
        "python -m pytest x.py",
        ".venv/bin/python scripts/plot.py a b",
        "git clone x",
    ],
)
def test_a_command_that_may_be(command: str) -> None:
    check(command.split())


@pytest.mark.parametrize(
    "command",
    [
        "headway run a.yaml --durations 2",
        "headway --duration 2",
        "headway ran a.yaml",
        "scripts/run --sed=3",
        "scripts/tests",
        "python -m no_such_module",
        "python scripts/no.py",
        "frobnicate --all",
    ],
)
def test_a_command_that_is_wrong(command: str) -> None:
    with pytest.raises(AssertionError):
        check(command.split())


def test_a_block_that_fails(tmp_path: Path) -> None:
    checkout(tmp_path)
    good = Block(1, "scripts/run --help | cat\ntest -f configs/arm2.yaml\n", "sh")
    run(good, tmp_path, "page")
    bad = Block(7, "headway run configs/arm2.yaml --set no=1 | cat\n", "sh")
    with pytest.raises(AssertionError, match=r"(?s)^page:7:.*exit code 2.*unknown key"):
        run(bad, tmp_path, "page")
