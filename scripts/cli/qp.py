"""`headway qp`: a tick's quadratic program from a record, and what solvers make of it."""

from __future__ import annotations

import json
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from zipfile import BadZipFile

from cyclopts import App, Parameter

from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import written_whole

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.controller.replay import Given

qp = App(name="qp", help="Looks at the quadratic program of a tick, offline.")


@qp.command
def dump(run: Path, tick: int, /, *, out: Path | None = None) -> int:
    """Writes the program of one tick of a run into a file for numpy.load.

    The file has what the tick was given, in SI; the program made of it, in the solver's scales (see
    controller/ocp.py): minimize z' P z / 2 + q' z subject to l <= A z <= u; what the solver said
    then; and the config. P (its upper half) and A are by columns: NAME_data, NAME_indices,
    NAME_indptr.

    Example: the hundredth tick of a run.

        headway qp dump runs/mine 100

    Parameters
    ----------
    run
        A run's folder, or its run.mcap.
    tick
        Of the task, from 0 on.
    out
        The file. If left out, qp-TICK.npz in the current folder.
    """
    import numpy as np

    from headway.controller.program import Program
    from headway.controller.record.reader import RecordError, read_run
    from headway.controller.replay import Replay, ReplayError

    try:
        record = read_run(run)
        replay = Replay(record)
        given, row = replay.given(tick), replay.row(tick)
    except (RecordError, ReplayError, ValueError) as error:
        raise Failure(ExitCode.USAGE, f"{run}: {error}") from error
    program = Program(replay.config, replay.prediction, replay.costs)
    _answer(program, given)
    constraints = program.constraints()
    arrays: dict[str, Any] = {f"given_{name}": value for name, value in asdict(given).items()}
    for name, matrix in (("P", program.hessian()), ("A", constraints)):
        arrays |= {
            f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr")
        }
    vectors = ("q", "gradient"), ("l", "lower"), ("u", "upper")
    arrays |= {name: program.pool[source][:, 0] for name, source in vectors}
    said = ("status", "iterations", "residual", "stationarity", "complementarity")
    arrays |= {f"recorded_{name}": record.arrays[f"solver_{name}"][row] for name in said}
    arrays["config"] = replay.config.model_dump_json()
    buffer = BytesIO()
    np.savez_compressed(buffer, **arrays)
    with written_whole(out or Path(f"qp-{tick}.npz")) as path:
        path.write_bytes(buffer.getvalue())
    print(f"written to {out or f'qp-{tick}.npz'}: {len(arrays['q'])} variables, "
          f"{len(arrays['l'])} constraints")  # fmt: skip
    return ExitCode.DONE


@qp.command
def solve(
    file: Path,
    /,
    *,
    backend: Literal["osqp", "hpipm", "riccati"] | None = None,
    nlp: Annotated[bool, Parameter(negative="--no-nlp")] = True,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Solves a dumped program again, and beside it the nonlinear problem that it stands for.

    The nonlinear problem has the machine's equations instead of their linearization, and is solved
    by IPOPT to 1e-9: how far the answer is from that is what one program a tick gives away. Model
    and costs of the task's own are read from their files as they are now.

    Example: by the other solver.

        headway qp solve qp-100.npz --backend hpipm

    Parameters
    ----------
    file
        From `headway qp dump`.
    backend
        The solver; if left out, the run's own.
    nlp
        The cross-check, which takes some seconds.
    to_json
        Prints the figures as JSON, and nothing else, on standard output.
    """
    import numpy as np

    from headway.configs.schema import Config
    from headway.controller.replay import Given

    try:
        with np.load(file, allow_pickle=False) as dumped:
            arrays = dict(dumped)
        config = Config.model_validate_json(str(arrays["config"]))
        given = Given(**{name: arrays[f"given_{name}"] for name in Given.__annotations__})
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise Failure(ExitCode.USAGE, f"{file}: is not of `headway qp dump`: {error}") from error
    try:
        figures = _figures(_with(config, backend), given, nlp)
    except ValueError as error:  # of the model or the task's own costs, which have changed since
        raise Failure(ExitCode.USAGE, f"{file}: {error}") from error
    figures["recorded"] = {
        name.removeprefix("recorded_"): value.item()
        for name, value in arrays.items()
        if name.startswith("recorded_")
    }
    if to_json:
        print(json.dumps(figures, indent=2))
    else:
        _show(figures)
    return ExitCode.DONE if figures["accepted"] else ExitCode.LIMIT


def _show(figures: dict[str, Any], indent: str = "") -> None:
    for name, value in figures.items():
        if isinstance(value, dict):
            print(f"{name}:")
            _show(value, "  ")
        else:
            print(
                f"{indent}{name}: " + (f"{value:.6g}" if isinstance(value, float) else f"{value}")
            )


def _with(config: Config, backend: str | None) -> Config:
    if backend is None:
        return config
    return config.model_copy(update={"mpc": config.mpc.model_copy(update={"backend": backend})})


def _answer(program: Any, given: Given) -> Any:
    """What the tick's feedback says, once more."""
    program.prepare(given.x, given.u, given.assumed, given.node_s)
    return program.feedback(given.start, given.d, given.reference, given.committed, given.holding)


def _figures(config: Config, given: Given, nlp: bool) -> dict[str, Any]:
    import numpy as np

    from headway.controller.nlp import converged
    from headway.controller.prediction import Prediction
    from headway.controller.program import Program
    from headway.controller.reference import own_costs, task_reference
    from headway.models.machine import load_machine

    machine = load_machine(Path(config.machine.model), config.machine.coupling)
    prediction = Prediction.of(config, machine)
    costs = own_costs(task_reference(config, Path()), machine)
    program = Program(config, prediction, costs)
    done = _answer(program, given)
    shape = program.pool["x"].shape
    figures: dict[str, Any] = {
        "backend": config.mpc.backend, "status": done.status, "accepted": done.accepted,
        "iterations": done.iterations, "residual": done.residual,
        "stationarity": done.stationarity, "complementarity": done.complementarity,
        "cost": program.cost(program.pool["z"][:, 0]),
    }  # fmt: skip
    if nlp:
        z, said = converged(program, machine, prediction.law)
        n = len(given.d)
        step = (program.pool["z"][:, 0] - z) * program.ocp.column_scale
        of_x = step[program.ocp.states].reshape(shape, order="F")
        figures["nlp"] = {
            "IPOPT says": said, "cost": program.cost(z),
            "position off by, at most": float(np.abs(of_x[:n]).max()),
            "velocity off by, at most": float(np.abs(of_x[n:]).max()),
            "torque off by, at most": float(np.abs(step[program.ocp.torques]).max()),
        }  # fmt: skip
    return figures
