"""scripts/mutate: a shard of the firmware's mutants, and the tool itself on small ones."""

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "scripts" / "mutation"
SHARD = "3/64"


def mutate(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, FOLDER, *words]
    return subprocess.run(command, capture_output=True, text=True)


def rows(path: Path) -> list[dict[str, str]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


# ---- the firmware


def test_a_shard_of_the_firmwares_mutants_is_killed_or_listed(tmp_path: Path) -> None:
    done = mutate("--shard", SHARD, "--json", tmp_path / "results.json")
    assert done.returncode == 0, done.stdout + done.stderr
    results = rows(tmp_path / "results.json")
    outcomes = [result["outcome"] for result in results]
    assert len(results) > 60 and outcomes.count("killed") > 0.8 * len(results)
    assert len({result["file"] for result in results}) >= 9
    assert len({result["kind"] for result in results}) >= 8


def test_the_vectors_reach_every_line_and_branch() -> None:
    done = mutate("--coverage")
    assert done.returncode == 0, done.stdout + done.stderr
    counts = re.findall(r"lines (\d+)/(\d+), branches (\d+)/(\d+)", done.stdout)
    assert len(counts) >= 9
    assert all(int(ran) > 0 for ran, *_ in counts)


# ---- the operators


@pytest.fixture(scope="module")
def tool() -> Iterator[dict[str, ModuleType]]:
    """The tool's modules by name; it is no package."""
    names = ("tokens", "operators", "accepted", "builder", "campaign")
    sys.path.insert(0, str(FOLDER))
    yield {name: importlib.import_module(name) for name in names}
    sys.path.remove(str(FOLDER))
    for name in names:
        del sys.modules[name]


def mutants(tool: dict[str, ModuleType], code: str, enums: Any = None) -> list[tuple[str, str]]:
    """Kind and changed code of each mutant."""
    source = tool["tokens"].Source(code)
    found = tool["operators"].Mutator(source, enums or {}).mutants()
    return [(m.kind, code[: m.start] + m.new + code[m.end :]) for m in found]


def of_body(tool: dict[str, ModuleType], body: str, kind: str, enums: Any = None) -> set[str]:
    """What one kind of operator makes of a function's body."""
    head = "int f(int a, int b, int *p) { "
    every = mutants(tool, f"{head}{body} }}", enums)
    return {text.removeprefix(head)[:-2] for k, text in every if k == kind}


@pytest.mark.parametrize(
    ("kind", "body", "expected"),
    [
        ("relation", "b = a < 7;", {"b = a <= 7;", "b = a >= 7;"}),
        ("relation", "b = a == b;", {"b = a != b;", "b = a <= b;", "b = a >= b;"}),
        ("relation", "b = a == BLUE;", {"b = a != BLUE;", "b = a <= BLUE;"}),
        ("relation", "b = a != BLUE;", {"b = a == BLUE;", "b = a > BLUE;"}),
        ("relation", "b = a == BLUE + 1;",
         {"b = a != BLUE + 1;", "b = a <= BLUE + 1;", "b = a >= BLUE + 1;"}),
        ("relation", "b = a == GREEN;", {"b = a != GREEN;", "b = a <= GREEN;", "b = a >= GREEN;"}),
        ("arithmetic", "b = a + b;", {"b = a - b;"}),
        ("arithmetic", "b = a << b;", {"b = a >> b;"}),
        ("arithmetic", "b = a & b;", {"b = a | b;", "b = a ^ b;"}),
        ("arithmetic", "b = a && b;", {"b = a || b;"}),
        ("arithmetic", "a++;", {"a--;"}),
        ("arithmetic", "a -= b;", {"a += b;", "a = b;"}),
        ("arithmetic", "b = (int32_t)-a;", set()),
        ("arithmetic", "b = *p;", set()),
        ("arithmetic", "g(&a, b);", set()),
        ("arithmetic", "const int32_t *q = p;", set()),
        ("arithmetic", "struct s *q = p;", set()),
        ("arithmetic", "b = a * *p;", {"b = a / *p;", "b = a + *p;"}),
        ("arithmetic", "b = p[0] - -a;", {"b = p[0] + -a;"}),
        ("sign", "b = (int32_t)-a;", {"b = (int32_t)a;"}),
        ("sign", "b = a - b;", set()),
        ("negation", "b = !a;", {"b = a;"}),
        ("constant", "b = 7;", {"b = 8;", "b = 6;", "b = 0;", "b = 1;"}),
        ("constant", "b = 0x80u;", {"b = 129u;", "b = 127u;", "b = 0u;", "b = 1u;"}),
        ("constant", "b = 0;", {"b = (-1);", "b = 1;"}),
        ("constant", "b = LIMIT;", {"b = (LIMIT - 1);", "b = (LIMIT + 1);"}),
        ("constant", "b = INT32_MAX;", {"b = (INT32_MAX - 1);"}),
        ("constant", "b = LIMIT(a);", set()),
        ("constant", "b = true;", {"b = false;"}),
        ("enumerator", "b = RED;", {"b = BLUE;", "b = GREEN;"}),
        ("cast", "b = (int32_t)a;", {"b = a;"}),
        ("cast", "b = (const struct s *)p;", {"b = p;"}),
        ("cast", "b = (a) + f(int32_t) + sizeof(int);", set()),
        ("swap", "g(a, b + 1, p);", {"g(b + 1, a, p);", "g(a, p, b + 1);"}),
        ("swap", "g(h(a, b));", {"g(h(b, a));"}),
        ("swap", "struct s v = {a, {b, 1}};",
         {"struct s v = {{b, 1}, a};", "struct s v = {a, {1, b}};"}),
        ("swap", "struct s v = {.x = a, .y = b};", set()),
        ("swap", "if (a) { }", set()),
        ("choice", "b = a ? 1 : 2;", {"b = a ? (2) : (1);"}),
        ("choice", "b = a ? b ? 1 : 2 : 3;",
         {"b = a ? (3) : (b ? 1 : 2);", "b = a ? b ? (2) : (1) : 3;"}),
        ("choice", "b = a ? 1 : b ? 2 : 3;",
         {"b = a ? (b ? 2 : 3) : (1);", "b = a ? 1 : b ? (3) : (2);"}),
        ("deletion", "a = b; g(a);", {"; g(a);", "a = b; ;"}),
        ("deletion", "for (;;) break;", {"for (;;) ;"}),
        ("deletion", "for (a = 0; a < b; a++) g(a);",
         {"for (a = 0; a < b; ) g(a);", "for (a = 0; a < b; a++) ;"}),
        ("deletion", "if (a) g(b); else g(a);", {"if (a) ; else g(a);", "if (a) g(b); else ;"}),
        ("deletion", "switch (a) { case 1: g(a); default: ; }",
         {"switch (a) { case 1: ; default: ; }"}),
        ("deletion", "int c = a; return c;", set()),
        ("initial value", "int c = a + b, d;", {"int c = 0, d;", "int c = 1, d;"}),
        ("initial value", "for (int i = a; i < b;) { }",
         {"for (int i = 0; i < b;) { }", "for (int i = 1; i < b;) { }"}),
        ("return", "g(); return a;", {"g(); return 0;", "g(); return 1;"}),
        ("condition", "if (a) { }",
         {"if (!(a)) { }", "if (((a), true)) { }", "if (((a), false)) { }"}),
        ("condition", "for (;a;) { }",
         {"for (;!(a);) { }", "for (;((a), true);) { }", "for (;((a), false);) { }"}),
        ("condition", "for (;;) { }", set()),
        ("body", "return a;", {"{ return 0; }"}),
    ],
)  # fmt: skip
def test_an_operator(tool: dict[str, ModuleType], kind: str, body: str, expected: set[str]) -> None:
    colours = ("RED", "GREEN", "BLUE")
    found = of_body(tool, body, kind, dict.fromkeys(colours, colours))
    if kind == "body":
        assert len(found) == 1
    else:
        assert found == expected


def test_bodies_return_zero_of_their_type(tool: dict[str, ModuleType]) -> None:
    code = "static void f(void) { g(); }\nstruct s h(void) { return x; }\n"
    code += "static inline int i(int a)\n{ return a; }\n"
    bodies = [text for kind, text in mutants(tool, code) if kind == "body"]
    assert "void f(void) { }\n" in bodies[0]
    assert "h(void) { return (struct s){0}; }\n" in bodies[1]
    assert "i(int a)\n{ return 0; }\n" in bodies[2]


def test_what_is_left_alone(tool: dict[str, ModuleType]) -> None:
    code = """
#define N (1 + 2) \\
    - 3
// a + 1
/* if (a < b) */
enum colour { RED = 1, GREEN };
struct s { int a[4]; };
extern const char *const text;
int f(int a[2 + 1]);
"""
    assert mutants(tool, code) == []
    strings = "void f(void) { g(\"a + 1 < 2\", '-'); }"
    assert {kind for kind, _ in mutants(tool, strings)} == {"body", "deletion", "swap"}


def test_an_entry_may_list_several_mutations(tool: dict[str, ModuleType], tmp_path: Path) -> None:
    path = tmp_path / "mutants.toml"
    path.write_text(
        "files = []\n[[survivor]]\nfile = 'a'\nfunction = 'b'\nline = 'c'\n"
        "mutation = ['1 -> 2', '1 -> 3']\nargument = 'why they all may live'\n"
    )
    keys = tool["accepted"].load(path).survivors
    assert {key.mutation for key in keys} == {"1 -> 2", "1 -> 3"}
    assert {str(key) for key in keys} == {"a: b: c: 1 -> 2", "a: b: c: 1 -> 3"}


def test_tables_outside_of_functions_are_changed(tool: dict[str, ModuleType]) -> None:
    enums = tool["operators"].enumerations(["enum c { RED, GREEN = 4, BLUE };"])
    assert enums == dict.fromkeys(("RED", "GREEN", "BLUE"), ("RED", "GREEN", "BLUE"))
    code = "static const struct s t[] = {{RED, 5}, {true, 2}};"
    found = {text[28:-1] for _, text in mutants(tool, code, enums)}
    assert {"{{GREEN, 5}, {true, 2}}", "{{RED, 6}, {true, 2}}", "{{RED, 5}, {false, 2}}"} <= found
    assert {"{{5, RED}, {true, 2}}", "{{true, 2}, {RED, 5}}"} <= found


def test_unmatched_brackets_are_told(tool: dict[str, ModuleType]) -> None:
    with pytest.raises(ValueError, match="line 2: unmatched"):
        tool["tokens"].Source("int a;\nint f() { g(; }")


def test_lines_of_a_mutant_are_those_of_its_statement(tool: dict[str, ModuleType]) -> None:
    code = "int f(int a) {\n    if (a <\n        1)\n        return a +\n            2;\n"
    code += "    return 3;\n}\n"
    found = tool["operators"].Mutator(tool["tokens"].Source(code), {}).mutants()
    lines = {(m.kind, m.lines) for m in found}
    assert ("relation", (2, 3)) in lines
    assert ("arithmetic", (4, 5)) in lines
    assert ("return", (6, 6)) in lines and ("body", (1, 7)) in lines


def test_like_mutations_of_a_line_are_numbered(tool: dict[str, ModuleType]) -> None:
    names = tool["accepted"].numbered(
        [("f", "x", "1 -> 2"), ("f", "x", "1 -> 2"), ("g", "x", "1 -> 2")]
    )
    assert names == ["1 -> 2", "1 -> 2 #2", "1 -> 2"]


def test_every_mutant_of_the_firmware_differs_from_every_other(tool: dict[str, ModuleType]) -> None:
    judged = tool["accepted"].load(ROOT / "tests" / "mutants.toml")
    keys = set()
    for file in judged.files:
        cases = tool["campaign"].cases(ROOT, file)
        texts = {case.changed for case in cases}
        assert len(texts) == len(cases) > 0 and cases[0].text not in texts
        keys |= {case.key for case in cases}
        assert len(keys & {c.key for c in cases}) == len(cases)


# ---- the campaign, on a firmware of one function

CLIP = """#include "clip.h"

// The value, or the limit above it.
int clip(int value, int limit) {
    int least = value;
    if (limit < value)
        least = limit;
    return least;
}
"""
JUDGE = """#include "clip.h"
#include <stdio.h>
#include <sys/resource.h>

int main(int argc, char **argv) {
    struct rlimit cpu = {JUDGE_CPU_S, JUDGE_CPU_S + 1};
    setrlimit(RLIMIT_CPU, &cpu);
    FILE *file = argc > 1 ? fopen(argv[1], "r") : 0;
    int value, limit, expected;
    while (file && fscanf(file, "%d %d %d", &value, &limit, &expected) == 3)
        if (clip(value, limit) != expected)
            return puts("no"), 1;
    return 0;
}
"""
GOOD = "1 5 1\n7 5 5\n-3 5 -3\n5 5 5\n"


class Tree:
    """A checkout with one file of firmware."""

    def __init__(self, root: Path, code: str = CLIP, vectors: str = GOOD) -> None:
        self.root = root
        for name in ("firmware", "tests/judge", "tests/vectors"):
            (root / name).mkdir(parents=True)
        (root / "firmware" / "clip.h").write_text("int clip(int value, int limit);\n")
        (root / "firmware" / "clip.c").write_text(code)
        (root / "tests" / "judge" / "judge.c").write_text(JUDGE)
        (root / "tests" / "vectors" / "clip.txt").write_text(vectors)
        self.accept()

    def accept(self, *entries: dict[str, Any], files: str = "firmware/clip.c") -> None:
        text = f'files = ["{files}"]\n'
        for entry in entries:
            values = "".join(f"{name} = {json.dumps(value)}\n" for name, value in entry.items())
            text += f"[[survivor]]\n{values}"
        (self.root / "tests" / "mutants.toml").write_text(text)

    def run(self, *words: str | Path) -> tuple[int, str, str]:
        done = mutate("--root", self.root, *words)
        return done.returncode, done.stdout, done.stderr

    def results(self) -> list[dict[str, str]]:
        path = self.root / "results.json"
        path.unlink(missing_ok=True)
        self.run("--json", path)
        return rows(path)


def entry(
    result: dict[str, str], argument: str = "it makes no difference at all"
) -> dict[str, str]:
    names = ("file", "function", "line", "mutation")
    return {name: result[name] for name in names} | {"argument": argument}


def test_a_survivor_makes_it_fail_and_an_entry_makes_it_pass(tmp_path: Path) -> None:
    tree = Tree(tmp_path)
    alive = [r for r in tree.results() if r["outcome"] == "survived"]
    assert alive == []  # with `limit <= value` the object code differs, the values do not
    code, out, _ = tree.run()
    assert code == 0 and re.search(r"^all .* 0 +0 ", out, re.MULTILINE)
    weak = Tree(tmp_path / "weak", vectors="1 5 1\n")
    code, out, err = weak.run()
    assert code == 1
    assert "firmware/clip.c:7: survived: least = limit removed" in out
    assert "  - least = limit;\n  + ;" in out
    assert "1 of" not in out
    assert "executable lines, 0 without a mutant" in err
    alive = [r for r in weak.results() if r["outcome"] == "survived"]
    weak.accept(*map(entry, alive))
    code, out, _ = weak.run()
    assert "survived:" not in out
    assert code == 1 and "more than 3%" in out
    weak.accept(*map(entry, alive))
    code, out, _ = weak.run("--shard", "0/2")  # the share is judged of the whole alone
    assert code == 0, out


def test_a_listed_mutant_that_is_killed_or_gone_is_an_error(tmp_path: Path) -> None:
    tree = Tree(tmp_path)
    killed = next(r for r in tree.results() if r["outcome"] == "killed")
    tree.accept(entry(killed))
    code, out, _ = tree.run()
    assert code == 1 and f"listed, but it is killed: firmware/clip.c: {killed['function']}" in out
    tree.accept(entry(killed | {"line": "least = 2 * limit;"}))
    code, out, _ = tree.run("--shard", "0/40")
    assert code == 1 and "listed, but there is no such mutant: firmware/clip.c: clip" in out
    tree.accept(entry(killed | {"file": "firmware/gone.c"}))
    assert tree.run()[0] == 1


def test_outcomes(tmp_path: Path) -> None:
    """Same object code, code that does not compile, loops, crashes, and what a sanitizer sees."""
    code = """#include "clip.h"
static int pick(const int *of, int at) { return of[at]; }
int clip(int value, int limit) {
    int both[2] = {value, limit};
    int spare = 3;
    for (int i = 0; i < 1; i++)
        both[0] += spare * 0;
    return pick(both, value > limit);
}
"""
    tree = Tree(tmp_path, code)
    results = {(r["line"], r["mutation"]): (r["outcome"], r["by"]) for r in tree.results()}

    def outcome(line: str, mutation: str) -> tuple[str, str]:
        return next(o for (code, m), o in results.items() if line in code and m == mutation)

    assert outcome("int spare", "3 -> 4")[0] == "equivalent"
    assert outcome("int pick", "body -> { return 0; }")[0] == "killed"
    assert (
        outcome("return pick", "both, value > limit -> value > limit, both")[0]
        == "does not compile"
    )
    assert outcome("for (", "step removed") == ("killed", "ended with -24")  # SIGXCPU
    shown = outcome("for (", "0 -> (-1)")
    assert shown[0] in ("survived", "equivalent")


def test_what_the_optimizer_finds_to_be_the_same_program_is_equivalent(tmp_path: Path) -> None:
    """A number without its sign is 0 where it is not above it; -O1 does not see that."""
    code = """#include "clip.h"
int clip(int value, int limit) {
    int low = limit & 7;
    int least = value;
    if (low == 0)
        least = limit;
    return least;
}
"""
    tree = Tree(tmp_path, code, vectors="1 5 1\n7 8 8\n1 -8 -8\n1 -1 1\n9 1 9\n")
    found = [r["outcome"] for r in tree.results() if r["mutation"] == "== -> <="]
    assert found == ["equivalent"]
    source, objects = tmp_path / "firmware" / "clip.c", []
    for text in (code, code.replace("low ==", "low <=")):
        source.write_text(text)
        subprocess.run(["cc", "-O1", "-c", source, "-o", tmp_path / "clip.o"], check=True)
        objects.append((tmp_path / "clip.o").read_bytes())
    assert objects[0] != objects[1]


def test_what_only_a_sanitizer_sees_is_killed(tmp_path: Path) -> None:
    kept = "    volatile int even = value / 2 * 2;\n    (void)even;\n    int least"
    code = CLIP.replace("    int least", kept)
    tree = Tree(tmp_path, code, vectors=GOOD + "2147483647 5 5\n")
    found = [r for r in tree.results() if r["mutation"] == "2 -> 3 #2"]
    assert [r["outcome"] for r in found] == ["killed"]
    assert "signed integer overflow" in found[0]["by"]


def test_a_sound_firmware_that_fails_is_no_verdict(tmp_path: Path) -> None:
    code, _, err = Tree(tmp_path, vectors="1 5 2\n").run()
    assert code == 2 and "the firmware as it is disagrees" in err
    code, _, err = Tree(tmp_path / "broken", CLIP.replace("least;", "leat;", 1)).run()
    assert code == 2 and "leat" in err


def test_coverage_wants_every_branch(tmp_path: Path) -> None:
    tree = Tree(tmp_path, vectors="1 5 1\n")
    code, out, _ = tree.run("--coverage")
    assert code == 1
    assert "firmware/clip.c: lines 4/5, branches 1/2" in out
    assert "firmware/clip.c:7: ran 0 times, branches []: least = limit;" in out
    (tree.root / "tests" / "vectors" / "clip.txt").write_text("1 5 2\n")
    code, _, err = tree.run("--coverage")
    assert code == 2 and "the firmware as it is disagrees" in err
    whole = Tree(tmp_path / "whole")
    code, out, _ = whole.run("--coverage")
    assert code == 0 and "lines 5/5, branches 2/2" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--shard", "2/2"], "give it as I/N"),
        (["--shard", "x"], "give it as I/N"),
        (["firmware/none.c"], "firmware/none.c is not judged"),
    ],
)
def test_mistakes_on_the_command_line(tmp_path: Path, words: list[str], message: str) -> None:
    code, _, err = Tree(tmp_path).run(*words)
    assert code == 2 and message in err and "Traceback" not in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("files = [", "mutants.toml"),
        ("", "without 'files'"),
        ('files = []\n[[survivor]]\nfile = "a"\n', "without 'function'"),
        ("files = []\n[[survivor]]\n" + "".join(f"{name} = 'a'\n" for name in
         ("file", "function", "line", "mutation", "argument")), "no argument for a"),
        ("files = []\n[[survivor]]\nfile = 'a'\nfunction = 'b'\nline = 'c'\n"
         "mutation = ['1 -> 2', '1 -> 2']\nargument = 'why it may live'\n",
         "listed twice: a: b: c"),
    ],
)  # fmt: skip
def test_mistakes_in_the_list(tmp_path: Path, text: str, message: str) -> None:
    tree = Tree(tmp_path)
    (tree.root / "tests" / "mutants.toml").write_text(text)
    code, _, err = tree.run()
    assert code == 2 and message in err and "Traceback" not in err


def test_an_aborted_campaign_goes_on_from_its_results(tmp_path: Path) -> None:
    tree, path = Tree(tmp_path), tmp_path / "kept.json"
    assert tree.run("--workers", "1", "--json", path)[0] == 0
    whole = path.read_text()
    lines = whole.splitlines(keepends=True)
    path.write_text("".join(lines[:2]) + lines[2][:9])  # aborted while it wrote the third
    code, _, err = tree.run("--workers", "1", "--json", path)
    assert code == 0 and f"2 of {len(lines)} are known" in err
    assert path.read_text() == whole
    kept = json.loads(lines[0]) | {"outcome": "survived"}
    path.write_text(json.dumps(kept) + "\n")  # what is known is not tried again
    assert tree.run("--json", path)[0] == 1
    (tree.root / "tests" / "vectors" / "clip.txt").write_text("1 5 1\n7 5 5\n")
    code, _, err = tree.run("--json", path)
    assert code == 2 and "of other firmware or vectors: remove it" in err
    path.write_text("[]\n")
    code, _, err = tree.run("--json", path)
    assert code == 2 and "no result: remove it" in err


def test_list_tries_none(tmp_path: Path) -> None:
    code, out, err = Tree(tmp_path).run("--list")
    assert code == 0 and err == ""
    assert "firmware/clip.c:6: relation: < -> <=" in out
