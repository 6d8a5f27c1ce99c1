"""A rule's outcome."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


class Status(enum.StrEnum):
    """How a value stands to its limit."""

    OK = "ok"
    WARN = "warn"  # it runs, but not as well as it could or not in every case
    FAIL = "FAIL"  # it cannot do what the config asks for


ORDER = (Status.OK, Status.WARN, Status.FAIL)


@dataclass(frozen=True)
class Rule:
    """One row of the table."""

    name: str
    status: Status
    value: float | None = None
    limit: float | None = None  # where ok ends
    unit: str = ""
    axis: str = ""  # the joint that it is worst at; empty: the whole machine
    remedy: str = ""  # what to change; empty if ok


def at_most(
    name: str,
    value: float,
    limit: float,
    unit: str,
    remedy: str,
    axis: str = "",
    warn: float = 1.0,
    fail: float = 1.0,
) -> Rule:
    """Ok up to `warn` times the limit, a warning up to `fail` times the limit."""
    status = Status.OK if value <= warn * limit else Status.FAIL
    if status is Status.FAIL and value <= fail * limit:
        status = Status.WARN
    told = "" if status is Status.OK else remedy
    return Rule(name, status, value, warn * limit, unit, axis, told)


def at_least(
    name: str,
    value: float,
    limit: float,
    unit: str,
    remedy: str,
    axis: str = "",
    fail: float | None = None,
) -> Rule:
    """Ok from the limit on, a warning down to `fail` (default: the limit itself)."""
    status = Status.OK if value >= limit else Status.FAIL
    if status is Status.FAIL and fail is not None and value >= fail:
        status = Status.WARN
    return Rule(name, status, value, limit, unit, axis, "" if status is Status.OK else remedy)


def worst(rules: Iterable[Rule]) -> Rule:
    """The one of several axes to show: by status, then by how near the value is to the limit."""

    def badness(rule: Rule) -> tuple[int, float]:
        near = 0.0
        if rule.value is not None and rule.limit:
            near = abs(float(np.log(max(abs(rule.value / rule.limit), 1e-12))))
        return ORDER.index(rule.status), -near

    return max(rules, key=badness)
