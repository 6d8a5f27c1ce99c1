"""Compiled CasADi functions: the cache is hit, healed and shared, and never silently wrong."""

import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from headway.cli.main import main
from headway.models.codegen import (
    Call,
    cache_dir,
    compile_functions,
    compile_mapped,
    named_function,
)
from headway.models.uncompiled import UncompiledError

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_dir() == tmp_path / "headway"
    return tmp_path / "headway"


def polynomial(power: int = 3) -> ca.Function:
    x = ca.SX.sym("x", 2)
    return ca.Function("polynomial", [x], [ca.sin(x) + x**power])


def evaluate(library: Path, name: str = "polynomial") -> list[float]:
    call = Call(library, name)
    call.inputs[0][:, 0] = 0.3, 2.0
    values: list[float] = call.run()[0].ravel().tolist()
    return values


EXPECTED = [np.sin(0.3) + 0.3**3, np.sin(2.0) + 8]


def test_a_function_is_compiled_once(cache: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first = compile_functions("poly", [polynomial()])
    assert "compiling poly" in capfd.readouterr().err
    (library,) = cache.iterdir()
    made = library.stat()
    second = compile_functions("poly", [polynomial()])
    assert capfd.readouterr().err == ""
    assert list(cache.iterdir()) == [library]
    assert (library.stat().st_ino, library.stat().st_mtime_ns) == (made.st_ino, made.st_mtime_ns)
    assert evaluate(first) == evaluate(second) == pytest.approx(EXPECTED, rel=1e-14)


def test_another_function_of_the_same_name_is_another_file(cache: Path) -> None:
    compile_functions("poly", [polynomial(3)])
    squared = compile_functions("poly", [polynomial(2)])
    assert len(list(cache.iterdir())) == 2
    assert evaluate(squared) == pytest.approx([np.sin(0.3) + 0.09, np.sin(2.0) + 4], rel=1e-14)


def test_several_functions_share_a_file(cache: Path) -> None:
    x = ca.SX.sym("x", 2)
    twice = ca.Function("twice", [x], [2 * x])
    both = compile_functions("pair", [polynomial(), twice])
    assert len(list(cache.iterdir())) == 1
    assert evaluate(both) == pytest.approx(EXPECTED, rel=1e-14)
    assert evaluate(both, "twice") == [0.6, 4.0]


def test_calls_through_buffers_give_the_same_numbers(cache: Path) -> None:
    call = Call(compile_functions("poly", [polynomial()]), "polynomial")
    call.inputs[0][:, 0] = 0.3, 2.0
    np.testing.assert_allclose(call.run()[0][:, 0], EXPECTED, rtol=1e-14)
    call.inputs[0][:, 0] = 0.0, 1.0
    np.testing.assert_allclose(call.run()[0][:, 0], [0.0, np.sin(1.0) + 1], rtol=1e-14)


def test_a_sparse_output_is_refused_by_name(cache: Path) -> None:
    x = ca.SX.sym("x", 2)
    sparse = ca.Function("holey", [x], [ca.diag(x)])
    with pytest.raises(ValueError, match="holey takes or gives a sparse matrix"):
        Call(compile_functions("sparse", [sparse]), "holey")


def test_functions_share_arrays_by_name(cache: Path) -> None:
    """What one writes the next one reads."""
    x = ca.SX.sym("x", 2)
    doubled = named_function("doubled", {"x": x}, {"y": 2 * x})
    library = compile_functions("pair", [doubled, named_function("added", {"y": x}, {"z": x + 1})])
    pool = {"x": np.array([[0.5], [2.0]], order="F")}
    first, then = Call(library, "doubled", pool), Call(library, "added", pool)
    first.run()
    assert then.run()[0].ravel().tolist() == [2.0, 5.0]
    assert list(pool) == ["x", "y", "z"] and pool["y"] is first.outputs[0] is then.inputs[0]
    with pytest.raises(ValueError, match="y is to be 2 by 1"):
        Call(library, "added", {"y": np.zeros((3, 1), order="F")})


@pytest.mark.parametrize("count", [1, 7, 8, 19])
def test_many_columns_at_a_time_are_as_one_by_one(cache: Path, count: int) -> None:
    """However many there are in a vector, and the last ones of them."""
    x, y = ca.SX.sym("x", 2, 3), ca.SX.sym("y", 2)
    root = ca.sqrt(1 + ca.sumsqr(x)) / (2 + ca.cos(y[1]))
    inner = ca.Function("inner", [x, y], [ca.sin(x) * y[0] - ca.tanh(y[1]), root * -y])
    a, b, c = ca.MX.sym("a", 2, 3), ca.MX.sym("b", 2), ca.MX.sym("c")
    first, second = inner(a, b)
    outputs = {"e": a.T @ first + c, "f": second / c}
    function = named_function("one", {"a": a, "b": b, "c": c}, outputs)
    call = Call(compile_mapped("many", function, count, [1]), "many")
    rng = np.random.default_rng(count)
    for array in call.inputs:
        array[...] = rng.uniform(0.5, 2, array.shape)
    expected = function.map("many", "serial", count, [1], [])(*call.inputs)
    for found, value in zip(call.run(), expected, strict=True):
        np.testing.assert_allclose(found, np.array(value), rtol=1e-13)


def test_a_sparse_output_of_many_columns_is_refused_by_name(cache: Path) -> None:
    x = ca.SX.sym("x", 2)
    library = compile_mapped("many", ca.Function("holey", [x], [ca.diag(x)]), 4, [])
    with pytest.raises(ValueError, match="many takes or gives a sparse matrix"):
        Call(library, "many")


def test_what_a_library_has_not_is_named(cache: Path) -> None:
    library = compile_functions("poly", [polynomial()])
    with pytest.raises(RuntimeError, match="missing"):
        Call(library, "parabola")
    with pytest.raises(RuntimeError, match="cannot load"):
        Call(library.with_name("nothing.so"), "polynomial")


def in_another_process() -> "subprocess.Popen[str]":
    """Compiles or loads the polynomial where nothing is loaded yet, and prints its values."""
    code = (
        "import casadi as ca, numpy as np\n"
        "from headway.models.codegen import Call, compile_functions\n"
        "x = ca.SX.sym('x', 2)\n"
        "f = ca.Function('polynomial', [x], [ca.sin(x) + x**3])\n"
        "call = Call(compile_functions('poly', [f]), 'polynomial')\n"
        "call.inputs[0][:, 0] = 0.3, 2.0\n"
        "print(*call.run()[0].ravel().tolist())\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def result(process: "subprocess.Popen[str]") -> tuple[list[float], str]:
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return [float(word) for word in out.split()], err


@pytest.mark.parametrize("damage", ["empty", "half", "flipped", "text"])
def test_a_damaged_library_is_built_anew(cache: Path, damage: str) -> None:
    compile_functions("poly", [polynomial()])
    (library,) = cache.iterdir()
    whole = library.read_bytes()
    broken = bytearray(whole)
    broken[len(whole) // 2] ^= 1
    content = {
        "empty": b"",
        "half": whole[: len(whole) // 2],
        "flipped": bytes(broken),
        "text": b"not a library\n" * 100,
    }[damage]
    # This process has the library loaded: another file of that name leaves its own alone.
    library.unlink()
    library.write_bytes(content)
    values, err = result(in_another_process())
    assert "compiling poly" in err
    assert values == pytest.approx(EXPECTED, rel=1e-14)
    assert list(cache.iterdir()) == [library]
    values, err = result(in_another_process())
    assert err == "" and values == pytest.approx(EXPECTED, rel=1e-14)


def test_processes_that_compile_at_the_same_time_do_no_harm(cache: Path) -> None:
    processes = [in_another_process() for _ in range(4)]
    for process in processes:
        values, _ = result(process)
        assert values == pytest.approx(EXPECTED, rel=1e-14)
    assert len(list(cache.iterdir())) == 1  # nor do they leave anything behind


@pytest.mark.parametrize("named", [None, "no-such-compiler"])
def test_without_a_compiler_the_error_says_what_to_install(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str | None
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    for variable in ("CC", "CXX"):
        if named:
            monkeypatch.setenv(variable, named)
        else:
            monkeypatch.delenv(variable, raising=False)
    with pytest.raises(UncompiledError, match=r"no C compiler found.*sudo apt-get install gcc"):
        compile_functions("poly", [polynomial()])
    with pytest.raises(
        UncompiledError, match=r"no C\+\+ compiler found.*sudo apt-get install g\+\+"
    ):
        compile_mapped("many", polynomial(), 4, [])
    assert not cache.exists() or not list(cache.iterdir())


def test_a_compiler_that_fails_is_reported_with_its_words(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\necho out of memory, says the compiler >&2\nexit 3\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    with pytest.raises(UncompiledError, match="out of memory, says the compiler"):
        compile_functions("poly", [polynomial()])
    assert list(cache.iterdir()) == []


def test_a_cache_that_cannot_be_is_told_to_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file where its folder should be, as for root nothing is read-only."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(UncompiledError, match="XDG_CACHE_HOME"):
        compile_functions("poly", [polynomial()])
    assert main(["run", str(CONFIG), "--duration", "0.1", "--out", str(tmp_path / "run")]) == 2
    assert "XDG_CACHE_HOME" in capsys.readouterr().err
