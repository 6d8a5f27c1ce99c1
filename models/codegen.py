"""CasADi functions as compiled C, cached by the hash of their source."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray


def cache_dir() -> Path:
    """Where compiled functions are kept between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "headway"


def compile_functions(name: str, functions: list[ca.Function]) -> dict[str, ca.Function]:
    """Generates one C file for all `functions`, compiles it once and loads it.

    The shared library is named by the hash of its source and put in place by a rename, so
    processes that compile at the same time do no harm to each other. It ends in a hash of its own,
    so a damaged one is built anew. Raises RuntimeError when there is no C compiler or it fails.
    """
    generator = ca.CodeGenerator(f"{name}.c")
    for function in functions:
        generator.add(function)
    source = generator.dump()
    digest = hashlib.sha256((source + ca.CasadiMeta.version()).encode()).hexdigest()[:20]
    library = cache_dir() / f"{name}-{digest}.so"
    if not _intact(library):
        _build(name, source, library)
    return {f.name(): ca.external(f.name(), str(library)) for f in functions}


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


def _build(name: str, source: str, library: Path) -> None:
    compiler = shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("no C compiler found: install one with `sudo apt-get install gcc`")
    print(f"compiling {name} (once) ...", file=sys.stderr)
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        c_file, built = Path(folder, "model.c"), Path(folder, "model.so")
        c_file.write_text(source)
        command = [compiler, "-O2", "-fPIC", "-shared", "-o", str(built), str(c_file), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
        seal = _seal(built.read_bytes())
        with built.open("ab") as file:  # what follows an ELF file's own end is ignored
            file.write(seal)
        built.replace(library)


class Call:
    """A compiled function bound to arrays: write `inputs`, run, read `outputs`.

    Goes through CasADi's buffers: 0.14 us of overhead where numpy arguments cost 50. Arrays are
    dense, float64, in Fortran order as CasADi has them, and belong to this object.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self.inputs: list[NDArray[np.float64]] = []
        self.outputs: list[NDArray[np.float64]] = []
        for i in range(function.n_in()):
            self.inputs.append(np.zeros(function.size_in(i), order="F"))
            self._buffer.set_arg(i, memoryview(self.inputs[i].T))  # type: ignore[call-arg, arg-type]
        for i in range(function.n_out()):
            if not function.sparsity_out(i).is_dense():
                raise ValueError(f"output {i} of {function.name()} is sparse; densify it")
            self.outputs.append(np.zeros(function.size_out(i), order="F"))
            self._buffer.set_res(i, memoryview(self.outputs[i].T))  # type: ignore[call-arg, arg-type]

    def fix_last(self, value: NDArray[np.float64]) -> None:
        """Gives the last input its value for good: it is no longer among `inputs`."""
        self._fixed = self.inputs.pop()  # kept, since the function reads it at each run
        self._fixed[:] = value

    def run(self) -> list[NDArray[np.float64]]:
        """Evaluates; returns `outputs`, which the next run overwrites."""
        self._evaluate()
        return self.outputs
