"""`headway check`: a config against the rules, before anything moves."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from headway.cli.changes import Changes
from headway.cli.failure import ExitCode

if TYPE_CHECKING:
    from headway.cli.rules import Rule

STYLES = {"ok": "green", "warn": "yellow", "FAIL": "bold red"}


def check(
    config: Path,
    /,
    *,
    overrides: Changes = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Holds a config against what is known of drives, networks and motion, without running it.

    Each rule has a value and the limit up to which it is ok, for the axis where it is worst. Beyond
    that it is a warning (it runs, but not in every case as well as it could) or a FAIL (it cannot
    do what it is asked for). Exits with 2 if anything fails.

    Example: would a margin of two knots do?

        headway check configs/arm2.yaml --set loop.margin_us=8192

    Parameters
    ----------
    config
        The YAML file of a machine and its task.
    overrides
        Changes one key of the config; may be repeated, as in `headway run`.
    to_json
        Prints {"rules": [{name, value, limit, unit, status, axis, remedy}]}, and nothing else, on
        standard output.
    """
    from headway.cli.rules import Status  # here, since it takes a second, and help should not

    rules = _rules(config, list(overrides or []))
    if to_json:
        print(json.dumps({"rules": [_plain(rule) for rule in rules]}, indent=2, allow_nan=False))
    else:
        _show(rules)
    failed = any(rule.status is Status.FAIL for rule in rules)
    return ExitCode.USAGE if failed else ExitCode.DONE


def _rules(config: Path, overrides: list[str]) -> list[Rule]:
    """All rules, or those up to the first without which the others say nothing."""
    from headway.cli.rules import Rule, Status, Subject, all_rules
    from headway.configs.load import ConfigError, load_config

    name = "config: can be read"
    try:
        checked = load_config(config, overrides)
    except ConfigError as error:
        return [Rule(name, Status.FAIL, remedy=str(error))]
    rules = [Rule(name, Status.OK)]
    name = "model: fits the config"
    path = (config.parent / checked.machine.model).resolve()
    try:
        subject = Subject(checked, path, config.parent)
    except ValueError as error:
        return [*rules, Rule(name, Status.FAIL, remedy=" ".join(str(error).split()))]
    return [*rules, Rule(name, Status.OK), *all_rules(subject)]


def _plain(rule: Rule) -> dict[str, object]:
    """JSON has no infinity: a time that never ends is null."""
    plain = asdict(rule) | {"status": str(rule.status)}
    finite = rule.value is not None and abs(rule.value) < float("inf")
    return plain | {"value": rule.value if finite else None}


def _show(rules: list[Rule]) -> None:
    table = Table("", "rule", "axis", "value", "limit", "unit", box=None, pad_edge=False)
    for rule in rules:
        status = f"[{STYLES[rule.status]}]{rule.status}[/]"
        value, limit = _text(rule.value), _text(rule.limit)
        table.add_row(status, escape(rule.name), escape(rule.axis), value, limit, rule.unit)
    console = Console()
    console.print(table)
    for rule in rules:
        if rule.remedy:
            console.print(f"[{STYLES[rule.status]}]{rule.status}[/] {escape(rule.name)}")
            console.print(f"     {escape(rule.remedy)}", highlight=False, soft_wrap=True)


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
