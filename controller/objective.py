"""A task's own costs, from a Python file of the user's.

The file has a function `objective` that takes Symbols and returns a list of terms, each a residual
and a weight, of which the program minimizes the sum of weight times |residual|^2 at every node of
the horizon. Residuals are linearized about the last plan (Gauss-Newton: Nocedal, Wright,
Numerical Optimization, 2006, section 10.3), so a term's curvature never goes below zero. What is to
be kept below zero becomes rows of the program, each with a slack at each node.
"""

from __future__ import annotations

import ast
import inspect
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from headway.models.codegen import named_function
from headway.models.dynamics import kinetic_energy, potential_energy
from headway.models.machine import Machine

Array = NDArray[np.float64]
Term = tuple[Any, Any]  # a residual (any, 1) and its weight, a number or an expression

FUNCTION = "objective"
TRIALS = 200  # states at which costs have to be numbers
WAYS, WAY_PARTS = 20, 32  # between states, on which they must not jump
JUMP = 1e-6  # of the residual, over 1e-11 of a way
KEPT_ROWS_MAX = 32  # at a node, of all that is kept below: each is one more in every solver's step
KEPT_WEIGHT_MAX = 1e12  # as of soft limits
KEPT_SIZE_MAX = 1e8  # of what is kept below and of its slope, times the root of its weight
ROUGH = {  # CasADi's operations whose slope says nothing
    getattr(ca, f"OP_{name}"): name.lower() for name in ("FLOOR", "CEIL", "SIGN", "FMOD")
}

# That may make a residual jump, or not: what is zero where it begins does not.
CHOICES = {getattr(ca, f"OP_{name}") for name in ("LT", "LE", "EQ", "NE", "NOT", "IF_ELSE_ZERO")}


class Symbols:
    """What a task's costs are made of, as CasADi expressions; SI.

    q, v (n, 1)       positions and velocities of the axes, in the config's order
    target (n, 1)     task.target_rad_or_m
    time_s            of the task, at the node
    share             of the horizon that has passed at the node: 0 to 1
    """

    def __init__(
        self, machine: Machine, target: Array, parameters: Sequence[Mapping[str, float]]
    ) -> None:
        n = machine.tree.count
        self.q, self.v = ca.SX.sym("q", n), ca.SX.sym("v", n)
        self.target, self.time_s = ca.SX(target), ca.SX.sym("time_s")
        self.share = ca.SX.sym("share")
        self._machine, self._given = machine, parameters
        self.parameters: dict[str, tuple[Any, list[float]]] = {}
        self.kept_below: list[tuple[Term, int]] = []  # columns, and the line that said so

    @property
    def x(self) -> Any:
        """[q, v] (2n, 1)."""
        return ca.vertcat(self.q, self.v)

    @property
    def numbers(self) -> Any:
        """The parameters that were asked for (p, 1)."""
        return ca.vertcat(*(symbol for symbol, _ in self.parameters.values()), ca.SX(0, 1))

    @property
    def values(self) -> list[Array]:
        """What they are (p,), and what they become."""
        of_each = [values for _, values in self.parameters.values()]
        return [np.array([values[i] for values in of_each]) for i in range(len(self._given))]

    def parameter(self, name: str, default: float) -> Any:
        """A number that task.parameters may give another value, without compiling anew, and
        mpc.later one after the other while the task runs."""
        if name not in self.parameters:
            values = [float(given.get(name, default)) for given in self._given]
            self.parameters[name] = ca.SX.sym(name), values
        return self.parameters[name][0]

    def keep_below(self, expression: Any, weight: Any) -> None:
        """The expression (any, 1) is to stay below zero at every node after the first: what is
        above costs `weight` times its square."""
        frame = inspect.currentframe()
        line = frame.f_back.f_lineno if frame is not None and frame.f_back is not None else 1
        self.kept_below.append(((expression, weight), line))

    def place(self, name: str) -> Any:
        """Where the origin of a body or a site is in the world (3, 1) [m]. Raises ValueError for a
        name that the model does not have."""
        return self._machine.place(name, self.q)

    def kinetic_energy(self) -> Any:
        """Of the whole machine, its armatures included [J]."""
        return kinetic_energy(self._machine.tree, self.q, self.v)

    def potential_energy(self) -> Any:
        """Of the whole machine in gravity, zero with all centres of mass at the world's origin
        [J]."""
        return potential_energy(self._machine.tree, self.q)


@dataclass(frozen=True)
class Costs:
    """A task's costs at one node as a function, and the values of its parameters.

    The functions take x (2n, 1), time_s, share and the parameters (p, 1): `function` to the
    curvature 2 J'WJ (2n, 2n) and the slope 2 J'Wr (2n, 1), `value` to the cost itself; `kept` to
    what is to stay below zero (`rows`, 1), times the root of its weight, and to its slope
    (`rows`, 2n). `later` are the parameters' values after each of mpc.later.
    """

    function: ca.Function
    value: ca.Function
    kept: ca.Function
    parameters: Array
    later: tuple[Array, ...] = ()

    @property
    def rows(self) -> int:
        """Of what is to stay below zero, at a node."""
        return int(self.kept.size1_out(0))

    def after(self, changes: int) -> Costs:
        """With the parameters after so many of mpc.later."""
        return replace(self, parameters=(self.parameters, *self.later)[changes], later=())


def read_costs(
    source: Path,
    machine: Machine,
    target: Array,
    parameters: Mapping[str, float],
    *later: Mapping[str, float],
) -> Costs:
    """Runs the user's file, which can do whatever a program of the user's can. `later`: what the
    parameters are after each of mpc.later.

    Raises ValueError with the line of what is wrong: what cannot be run, is no list of terms, has
    another shape, is not a number somewhere or has no slope.
    """
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeError) as error:
        raise ValueError(f"task.file: {source}: cannot be read: {error}") from error
    symbols = Symbols(machine, target, [parameters, *later])
    returned = _run(source, text, symbols)
    lines = _lines(text)
    if not isinstance(returned, list | tuple):
        words = f"returns {_a(returned)}, not a list of terms: each is (residual, weight)"
        raise _wrong(source, lines[0], words)
    for given, key in ((set(parameters), "task.parameters"), (set().union(*later), "mpc.later")):
        if unknown := sorted(given - set(symbols.parameters)):
            known = ", ".join(symbols.parameters) or "none"
            raise ValueError(
                f"{key} has {', '.join(unknown)}, which {source} does not ask for; it asks for: "
                f"{known}"
            )
    places = dict(enumerate(lines[1:]))
    checked = [
        _checked(source, places.get(i, lines[0]), symbols, f"term {i}", term)
        for i, term in enumerate(returned)
    ]
    kept: list[Term] = []
    for i, (term, line) in enumerate(symbols.kept_below):
        kept.append(_checked(source, line, symbols, f"keep_below {i}", term, "expression"))
        _require_moderate(source, line, symbols, f"keep_below {i}", kept[-1])
        rows = sum(expression.numel() for expression, _ in kept)
        if rows > KEPT_ROWS_MAX:
            words = (
                f"keep_below {i} makes it {rows} rows at a node, and {KEPT_ROWS_MAX} are the most: "
                "leave out those that others imply, or put the largest of several in one"
            )
            raise _wrong(source, line, words)
    return _costs(symbols, checked, kept)


def _costs(symbols: Symbols, terms: list[Term], kept: list[Term]) -> Costs:
    x, (values, *later) = symbols.x, symbols.values
    curvature, slope = ca.SX(x.numel(), x.numel()), ca.SX(x.numel(), 1)
    value = ca.SX(1, 1)
    for residual, weight in terms:
        by_state = ca.jacobian(residual, x)
        curvature += 2 * weight * by_state.T @ by_state
        slope += 2 * weight * by_state.T @ residual
        value += weight * ca.sumsqr(residual)
    inputs = {
        "x": x, "time_s": symbols.time_s, "share": symbols.share, "costs": symbols.numbers,
    }  # fmt: skip
    outputs = {"curvature": curvature, "slope": slope}
    # By the root of its weight a slack costs its square, whatever the weight is and becomes.
    below = ca.vertcat(ca.SX(0, 1), *(ca.sqrt(weight) * expression for expression, weight in kept))
    rows = {"kept": below, "kept_slope": ca.jacobian(below, x)}
    return Costs(
        named_function("costs", inputs, outputs),
        named_function("value", inputs, {"value": value}),
        named_function("keep", inputs, rows),
        values,
        tuple(later),
    )


def _run(source: Path, text: str, symbols: Symbols) -> Any:
    """What the function returns; the user's mistakes with the line of their file."""
    space: dict[str, Any] = {"__name__": source.stem, "__file__": str(source)}
    try:
        exec(compile(text, str(source), "exec"), space)
        if not callable(space.get(FUNCTION)):
            raise ValueError(f"task.file: {source}: has no function {FUNCTION}(symbols)")
        return space[FUNCTION](symbols)
    except SyntaxError as error:
        of = Path(error.filename or source)  # it may be of a file that this one imports
        raise _wrong(of, error.lineno or 1, f"is not Python: {error.msg}") from error
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame.lineno for frame in frames if frame.filename == str(source) and frame.lineno]
        words = " ".join(str(error).split()) or type(error).__name__
        raise _wrong(source, own[-1] if own else _lines(text)[0], words) from error


def _lines(text: str) -> list[int]:
    """Where the function returns, and where each term of what it returns begins, if that is written
    there as a list."""
    functions = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef) and node.name == FUNCTION
    ]
    for function in functions:
        for node in ast.walk(function):
            if isinstance(node, ast.Return):
                terms = [
                    element.lineno
                    for call in ast.walk(node)
                    if isinstance(call, ast.List)
                    for element in call.elts
                ]
                return [node.lineno, *terms]
        return [function.lineno]
    return [1]


def _checked(
    source: Path, line: int, symbols: Symbols, name: str, term: Any, noun: str = "residual"
) -> Term:
    """A term as expressions, if it is one that has values and slopes everywhere."""
    try:
        residual, weight = (ca.SX(part) for part in term)
    except (TypeError, ValueError, NotImplementedError) as error:
        is_what = f"of {' and '.join(map(_a, term))}" if isinstance(term, tuple) else _a(term)
        words = (
            f"{name} is {is_what}, not {noun} and weight: an SX column (ca.vertcat) and a number"
        )
        raise _wrong(source, line, words) from error
    if residual.shape[1] != 1 or weight.numel() != 1:
        raise _wrong(
            source,
            line,
            f"{name} has {noun} and weight of {residual.shape[0]} by {residual.shape[1]} and of "
            f"{weight.shape[0]} by {weight.shape[1]}: make it a column and a number",
        )
    x = symbols.x
    if ca.depends_on(weight, x):
        raise _wrong(
            source, line, f"{name} has a weight that depends on q or v: only its {noun} may"
        )
    inputs = [x, symbols.time_s, symbols.share, symbols.numbers]
    # Of itself, as a slope may have a step where it kinks.
    said = ca.Function("said", inputs, [residual, weight], {"allow_free": True})
    if said.has_free():
        own = f"{name} has a symbol of its own, {said.get_free()[0]}"
        raise _wrong(source, line, f"{own}: make it of what {FUNCTION} is given")
    function = ca.Function("term", inputs, [residual, weight, ca.jacobian(residual, x)])
    operations = {said.instruction_id(k) for k in range(said.n_instructions())}
    rough = {ROUGH[op] for op in operations if op in ROUGH}
    if rough:
        words = f"{name} is not differentiable: it has {', '.join(sorted(rough))}"
        raise _wrong(source, line, words)
    for state, found in _tried(symbols, function):
        if not all(np.isfinite(np.array(part)).all() for part in found):
            at = ", ".join(f"{value:.4g}" for value in state)
            words = f"{name} is not a number, or has no slope, at [q, v] = [{at}]"
            raise _wrong(source, line, words)
        if float(found[1]) < 0:
            raise _wrong(source, line, f"{name} has a negative weight, {float(found[1]):.4g}")
    if CHOICES & operations:
        _require_no_jump(source, line, symbols, name, function)
    return residual, weight


def _tried(symbols: Symbols, function: ca.Function) -> Iterator[tuple[Array, Any]]:
    """A function at zero and at states at random, in turn with each of the parameters' values:
    the states (2n,), and what it makes of them."""
    rng, size = np.random.default_rng(0), symbols.x.numel()
    for trial in range(TRIALS):
        state = np.zeros(size) if trial == 0 else rng.uniform(-np.pi, np.pi, size)
        values = symbols.values[trial % len(symbols.values)]
        yield state, function(state, rng.uniform(0, 10), rng.uniform(), values)


def _require_moderate(source: Path, line: int, symbols: Symbols, name: str, term: Term) -> None:
    """Raises ValueError for what would leave a solver no accuracy for anything else."""
    expression, weight = term
    size = ca.sqrt(weight) * ca.vertcat(expression, ca.vec(ca.jacobian(expression, symbols.x)))
    inputs = [symbols.x, symbols.time_s, symbols.share, symbols.numbers]
    function = ca.Function("size", inputs, [weight, ca.mmax(ca.fabs(ca.vertcat(0, size)))])
    for _, found in _tried(symbols, function):
        weighs, largest = (float(part) for part in found)
        if weighs > KEPT_WEIGHT_MAX or largest > KEPT_SIZE_MAX:
            words = (
                f"{name} has a weight of {weighs:.4g}, whose root makes it {largest:.4g}: "
                f"{KEPT_WEIGHT_MAX:.0e} and {KEPT_SIZE_MAX:.0e} are the most"
            )
            raise _wrong(source, line, words)


def _require_no_jump(
    source: Path, line: int, symbols: Symbols, name: str, function: ca.Function
) -> None:
    """Raises ValueError if the residual jumps on the way between states at random: where it changes
    most on such a way the half in which it does is halved again, until what does not jump would
    not have changed."""
    rng, size = np.random.default_rng(1), 2 * symbols.q.numel()
    parameters = symbols.values[0]

    def at(state: Array, time_s: float, share: float) -> Array:
        return np.array(function(state, time_s, share, parameters)[0])[:, 0]

    for _ in range(WAYS):
        begin, end = rng.uniform(-np.pi, np.pi, (2, size))
        when = rng.uniform(0, 10), rng.uniform()
        places = np.linspace(begin, end, WAY_PARTS)
        values = np.array([at(place, *when) for place in places])
        part = int(np.abs(np.diff(values, axis=0)).max(axis=1).argmax())
        (low, high), (first, last) = places[part : part + 2], values[part : part + 2]
        for _ in range(40):
            middle = (low + high) / 2
            value = at(middle, *when)
            if np.abs(value - first).max() > np.abs(last - value).max():
                high, last = middle, value
            else:
                low, first = middle, value
        if np.abs(last - first).max() > JUMP * (1 + np.abs(values).max()):
            place = ", ".join(f"{number:.4g}" for number in low)
            raise _wrong(source, line, f"{name} is not differentiable: it jumps at [{place}]")


def _a(value: Any) -> str:
    return f"a {type(value).__name__}"


def _wrong(source: Path, line: int, words: str) -> ValueError:
    return ValueError(f"task.file: {source}:{line}: {words}")
