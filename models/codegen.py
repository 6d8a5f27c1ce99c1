"""Functions as compiled C, CasADi's and our own, cached by the hash of their source."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from headway.models._generated import Bound, shapes
from headway.models.uncompiled import UncompiledError

Array = NDArray[np.float64]

FLAGS = "-O3", "-march=native", "-fPIC", "-shared"  # a quarter faster than without the first two

Told = Callable[[str, bool], None]  # a library's name, and whether it has to be compiled


def _say(name: str, new: bool) -> None:
    if new:
        print(f"compiling {name} (once) ...", file=sys.stderr)


_told: ContextVar[Told] = ContextVar("told", default=_say)

# The variable that names the compiler, what it is called, and where it comes from.
COMPILERS = {"c": ("CC", "cc", "gcc"), "c++": ("CXX", "c++", "g++")}


def cache_dir() -> Path:
    """Where compiled functions are kept between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "headway"


@contextmanager
def telling(told: Told) -> Iterator[None]:
    """While it lasts `told` is called for each library that is asked for, before it is compiled, in
    place of a line on standard error for those that are."""
    before = _told.set(told)
    try:
        yield
    finally:
        _told.reset(before)


def compile_functions(name: str, functions: list[ca.Function]) -> Path:
    """Generates one C file for all `functions`, see `compile_source`."""
    generator = ca.CodeGenerator(f"{name}.c")
    for function in functions:
        generator.add(function)
    return compile_source(name, generator.dump() + f"\n// CasADi {ca.CasadiMeta.version()}\n")


def compile_mapped(name: str, function: ca.Function, count: int, shared: list[int]) -> Path:
    """`function.map(name, "serial", count, shared, [])` as compiled code that works out as many
    columns at a time as the processor's vectors hold: a third of the time. See `compile_source`.

    Lanes are C++; lanes.hpp has the functions of numbers that there are for them.
    """
    generator = ca.CodeGenerator(f"{name}.c", {"casadi_real": "Lanes"})
    generator.add(function)
    once = ", ".join(str(int(i in shared)) for i in range(function.n_in()))
    names = {"ONE": function.name(), "MAPPED": name, "COUNT": count, "SHARED": f"{{{once}}}"}
    defined = "".join(f"#define {key} {value}\n" for key, value in names.items())
    defined += f"#define OUTPUTS {function.n_out()}\n"
    lanes, mapped = (
        Path(__file__).with_name(f"{of}.hpp").read_text() for of in ("lanes", "mapped")
    )
    return compile_source(name, "".join((lanes, generator.dump(), defined, mapped)), "c++")


def compile_source(name: str, source: str, language: Literal["c", "c++"] = "c") -> Path:
    """Compiles one file once; returns the library.

    The shared library is named by the hash of its source and put in place by a rename, so
    processes that compile at the same time do no harm to each other. It ends in a hash of its own,
    so a damaged one is built anew. Raises UncompiledError when there is no compiler, when it fails,
    and when the cache cannot be used.
    """
    made_of = language + source + " ".join(FLAGS) + _processor()
    digest = hashlib.sha256(made_of.encode()).hexdigest()[:20]
    library = cache_dir() / f"{name}-{digest}.so"
    try:
        new = not _intact(library)
        _told.get()(name, new)
        if new:
            _build(name, source, language, library)
    except OSError as error:
        raise UncompiledError(
            f"{error.filename or library}: {error.strerror}: compiled models are kept there; make "
            "it writable, or name another place in XDG_CACHE_HOME"
        ) from error
    return library


def _processor() -> str:
    """What the compiler may count on here: a cache can be shared with other computers."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def _seal(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


def _intact(library: Path) -> bool:
    """Whether the file is there and whole: loading half a library can kill the process."""
    try:
        content = library.read_bytes()
    except FileNotFoundError:
        return False
    size = len(content) - len(_seal(b""))
    return size > 0 and content[size:] == _seal(content[:size])


def _build(name: str, source: str, language: str, library: Path) -> None:
    variable, usual, package = COMPILERS[language]
    compiler = shutil.which(os.environ.get(variable) or usual) or shutil.which(package)
    if compiler is None:
        raise UncompiledError(
            f"no {language.upper()} compiler found: install one with "
            f"`sudo apt-get install {package}`"
        )
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        file, built = Path(folder, "model.c"), Path(folder, "model.so")
        file.write_text(source)
        command = [compiler, *FLAGS, "-o", str(built), "-x", language, str(file), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise UncompiledError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
        seal = _seal(built.read_bytes())
        with built.open("ab") as whole:  # what follows an ELF file's own end is ignored
            whole.write(seal)
        built.replace(library)


class Call:
    """A compiled function bound to arrays: write `inputs`, run, read `outputs`.

    Arrays are dense, float64, in Fortran order as CasADi has them. They stay where they are, so
    that functions can share them by name: what one writes the next one reads. `bound` keeps them.
    """

    def __init__(self, library: Path, name: str, pool: dict[str, Array] | None = None) -> None:
        """`pool`: arrays by the names of inputs and outputs; those that it lacks are made.

        Raises ValueError if an array is of another shape than the function's.
        """
        pool = {} if pool is None else pool
        shapes_in, shapes_out = shapes(str(library), name)
        self.inputs = [self._shared(pool, *shape) for shape in shapes_in]
        self.outputs = [self._shared(pool, *shape) for shape in shapes_out]
        self.bound = Bound(str(library), name, self.inputs, self.outputs)

    @staticmethod
    def _shared(pool: dict[str, Array], key: str, rows: int, columns: int) -> Array:
        array = pool.setdefault(key, np.zeros((rows, columns), order="F"))
        if array.shape != (rows, columns) or not array.flags.f_contiguous:
            raise ValueError(f"{key} is to be {rows} by {columns}, in Fortran order")
        return array

    def run(self) -> list[Array]:
        """Evaluates; returns `outputs`, which the next run overwrites."""
        self.bound.run()
        return self.outputs


def named_function(name: str, inputs: dict[str, Any], outputs: dict[str, Any]) -> ca.Function:
    """A function of expressions whose arrays can be shared by name, see `Call`."""
    dense = [ca.densify(value) for value in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))


def among(rows: Any, places: list[int], n: int) -> Any:
    """Rows at their places among n, the others zero: an expression."""
    every = [ca.MX(1, rows.shape[1])] * n
    for place, row in zip(places, ca.vertsplit(rows), strict=True):
        every[place] = row
    return ca.vertcat(*every)
