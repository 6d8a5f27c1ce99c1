"""A config's task in closed loop, simulated in memory: for tests and sweeps."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from headway.cli.summary import summarize
from headway.cli.versions import versions
from headway.configs.save import save_config
from headway.configs.schema import Config
from headway.controller.record.channels import CHANNELS
from headway.controller.record.reader import NAME
from headway.controller.record.recorder import Memory
from headway.controller.record.target import About, Target
from headway.sim.lockstep import Lockstep


class MemoryRecord(Memory):
    """A record in memory that can still become a file."""

    def write(self, path: Path, about: About, complete: bool) -> None:
        """Writes the file that `headway run` would have left. Raises OSError."""
        with path.open("xb") as file:
            target = Target(file, about)
            for batch in self._batches:
                target.write(batch)
            target.finish(complete, dropped=0)


class Simulation:
    """One run of a config, from power-up to rest."""

    def __init__(self, config: Config, folder: Path) -> None:
        """`folder` is where the config's relative paths start."""
        self.config, self.folder = config, folder
        self.record = MemoryRecord()
        self.summary: dict[str, Any] | None = None  # once the run has come to its end

    def run(self) -> dict[str, Any]:
        """Runs and sums up. Raises DeviceError and UnstableError, and ValueError if config and
        model do not fit together or the task has no tick."""
        lockstep = Lockstep(self.config, self.folder, self.record)
        lockstep.run()
        if not lockstep.ticks:
            raise ValueError("sim.kill_host_at_s: the host does not even live for one tick")
        arrays = self.record.arrays()
        messages = {channel: len(arrays[f"{channel}_us"]) for channel in CHANNELS}
        kept = {"complete": True, "batches_dropped": 0, "messages": messages}
        self.summary = {**summarize(self.config, lockstep, arrays), "record": kept}
        return self.summary

    def keep(self, folder: Path) -> None:
        """Writes what `headway run` leaves into an empty folder: the config, the record and, of a
        run that came to its end, the summary. Raises OSError."""
        save_config(self.config, self.folder, folder / "config.yaml")
        text = (folder / "config.yaml").read_text(encoding="utf-8")
        about = About(text, self.config.seed, versions())
        self.record.write(folder / NAME, about, complete=self.summary is not None)
        if self.summary is not None:
            text = json.dumps(self.summary, indent=2, allow_nan=False) + "\n"
            (folder / "summary.json").write_text(text, encoding="utf-8")


def changes_of(overrides: Mapping[str, Any]) -> list[str]:
    """`key.path=value`, as `--set` takes it, of dotted keys and Python values.

    Numbers and arrays of numpy count as numbers and lists. Raises TypeError for what YAML has not.
    """
    return [f"{key}={_yaml(key, value)}" for key, value in overrides.items()]


def _yaml(key: str, value: Any) -> str:
    """JSON is YAML."""
    try:
        return json.dumps(value, ensure_ascii=False, default=lambda array: array.tolist())
    except (AttributeError, TypeError) as error:
        raise TypeError(f"{key}: {value!r} is no number, text, list or dict") from error


def replay_command(path: Path | str, changes: Sequence[str], seed: int) -> str:
    """The command that runs a config with these changes once more."""
    options, more = {"duration_s": "", "seed": str(seed)}, list[str]()
    for change in changes:
        key, _, value = change.partition("=")
        if key in options:
            options[key] = value
        else:
            more += ["--set", change]
    duration = ["--duration", options["duration_s"]] if options["duration_s"] else []
    return shlex.join(["headway", "run", str(path), *duration, "--seed", options["seed"], *more])
