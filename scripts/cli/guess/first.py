"""From a model's file to the text of a first config."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from headway.cli.guess.axes import AxisGuess, axes_of
from headway.cli.guess.drive import dampings, guess_drive, stiffnesses
from headway.cli.guess.horizon import HORIZONS, horizon
from headway.cli.guess.limits import guess_limits
from headway.cli.guess.task import Gentle, gentle_task
from headway.cli.guess.text import Draft, text_of
from headway.cli.guess.weights import Weights
from headway.cli.rules import Rule, Subject, all_rules
from headway.configs import schema
from headway.configs.schema import Config, Device
from headway.models.envelope import envelope
from headway.models.machine import load_machine
from headway.models.stated import stated


def first_config(model: Path, target: Path) -> tuple[str, list[Rule]]:
    """The text of a config to be written to `target`, and how it stands to the rules.

    Raises ValueError for a model that cannot be used.
    """
    draft = _standing_still(model, target)
    task = gentle_task(_subject(draft, model))
    if task is None:
        raise ValueError(
            f"{model}: no pose was found that the drives can hold with half of their limits: give "
            "the joints higher limits of effort, or smaller ranges"
        )
    draft = replace(draft, task=task)
    draft = replace(draft, horizon=horizon(_subject(draft, model)))
    return text_of(draft), all_rules(_subject(draft, model))


def _standing_still(model: Path, target: Path) -> Draft:
    """All but the task and the horizon."""
    machine = load_machine(model)
    axes: list[AxisGuess] = axes_of(stated(model, machine.joints))
    low, high = np.array([axis.poses for axis in axes]).T
    reach = envelope(machine, low, high)
    damping = dampings(reach, machine.damping)
    stiffness = stiffnesses(reach, damping)
    period_s = Device().servo_period_us * 1e-6
    for i, axis in enumerate(axes):
        most, least = float(reach.inertia_max[i]), float(reach.inertia_min[i])
        guess_limits(axis, most, least, float(reach.holding_max[i]))
        guess_drive(axis, float(stiffness[i]), float(damping[i]), most, period_s)
    return Draft(
        re.sub(r"[^A-Za-z0-9_-]", "_", model.stem)[:25],
        os.path.relpath(model, target.parent),
        os.path.relpath(Path(schema.__file__).with_name("schema.json"), target.parent),
        axes,
        Gentle(0.1, (low + high) / 2, 0 * low, 0 * low),
        HORIZONS[0],
        Weights.of(axes, reach),
    )


def _subject(draft: Draft, model: Path) -> Subject:
    """The draft with its model, as the rules look at them."""
    return Subject(Config.model_validate(YAML().load(text_of(draft))), model)
