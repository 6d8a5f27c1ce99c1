"""`headway init`: a first config for a machine, from its model."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from headway.cli.failure import ExitCode, Failure


def init(
    model: Path,
    /,
    *,
    out: Path | None = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Writes a first config for a machine, from its model.

    The model is an MJCF (.xml) or a URDF (.urdf) whose joints are hinges and slides; each becomes
    an axis with a motor, an encoder and a board. What the model does not say is guessed from its
    dynamics, and the file tells so beside each such value. The file can be run at once.

    Example: from a URDF to a first motion in simulation.

        headway init robots/arm.urdf --out arm.yaml
        headway check arm.yaml
        headway run arm.yaml --duration 2

    Parameters
    ----------
    model
        The machine's MJCF or URDF file.
    out
        The file to write; it must not exist yet. Default: the model's name with .yaml, here.
    to_json
        Prints {"config", "guessed", "rules": [{status, name, remedy}]} (the rules that are not ok),
        and nothing else, on standard output.
    """
    if not model.is_file():
        raise Failure(ExitCode.USAGE, f"{model}: there is no such file")
    target = out or Path(f"{model.stem}.yaml")
    if target.exists():
        raise Failure(ExitCode.USAGE, f"{target}: exists already; choose another name by --out")
    from headway.cli.guess.first import first_config  # here, since it takes a second to import
    from headway.cli.rules import Status

    try:
        text, rules = first_config(model.resolve(), target.resolve())
    except ValueError as error:
        raise Failure(ExitCode.USAGE, " ".join(str(error).split())) from error
    _write_new(target, text)
    told = [rule for rule in rules if rule.status is not Status.OK]
    guessed = text.count("# guessed:")
    if to_json:
        notes = [{"status": rule.status, "name": rule.name, "remedy": rule.remedy} for rule in told]
        report = {"config": str(target), "guessed": guessed, "rules": notes}
        print(json.dumps(report, indent=2, allow_nan=False))
        return ExitCode.DONE
    print(f"written to {target}, with {guessed} guessed values")
    for rule in told:
        print(f"{rule.status} {rule.name}: {rule.remedy}")
    print(f"next: headway check {target}; headway run {target} --duration 2")
    return ExitCode.DONE


def _write_new(target: Path, text: str) -> None:
    """All of the file or nothing, and never over another one. Raises Failure."""
    sibling = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        try:
            sibling.write_text(text, encoding="utf-8")
            os.link(sibling, target)  # fails if somebody else has made it meanwhile
        finally:
            sibling.unlink(missing_ok=True)
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{target}: cannot be written: {error.strerror}") from error
