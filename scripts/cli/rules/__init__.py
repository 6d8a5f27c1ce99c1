"""What `headway check` holds a config against: each rule from theory, none by running it."""

from __future__ import annotations

from headway.cli.rules.clocks import clock_rules
from headway.cli.rules.drive import drive_rules
from headway.cli.rules.rule import Rule, Status
from headway.cli.rules.subject import Subject
from headway.cli.rules.task import task_rules
from headway.cli.rules.timing import timing_rules

__all__ = ["Rule", "Status", "Subject", "all_rules"]


def all_rules(subject: Subject) -> list[Rule]:
    """Every rule that a config and its model can be held against once both are read."""
    return [
        *task_rules(subject),
        *drive_rules(subject),
        *timing_rules(subject),
        *clock_rules(subject),
    ]
