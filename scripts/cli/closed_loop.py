"""What the fixture `closed_loop` is and gives: a config's run, and what a test may ask of it."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from headway.cli import judge
from headway.cli.judge import Arrays, Bound, by_axis
from headway.cli.simulation import Simulation, changes_of, replay_command
from headway.configs.load import ConfigError, load_config
from headway.configs.schema import Config
from headway.controller.tick import DeviceError
from headway.sim.plant import UnstableError

FORESEEN = FileNotFoundError, ConfigError, ValueError, TypeError, DeviceError, UnstableError
CACHED_MAX = 8  # ten seconds of a two-axis machine take 30 MB


@dataclass(frozen=True)
class ClosedLoopRun:
    """What a run was, and what a test may ask of it.

    Each `assert_...` raises AssertionError with the axis, the value, the limit, the time and the
    command that repeats the run. A bound is a number, for all axes, or a dict for those that it
    names: `{"q1": 0.5}`.
    """

    config: Config = field(repr=False)  # as used
    arrays: Arrays = field(repr=False)  # the record, read-only: CHANNEL_FIELD, as in docs/record.md
    summary: dict[str, Any] = field(repr=False)  # as in summary.json
    replay: str  # the command that repeats the run
    simulation: Simulation = field(repr=False)

    def assert_within_limits(self, margin: float = 0.0) -> None:
        """True position and speed, and the torque or force asked for, stayed within the config's
        limits.

        margin: share of each limit, and of the position's range at either end, that stayed free.
        """
        __tracebackhide__ = True
        self._require(judge.beyond_limits(self.config, self.arrays, margin))

    def assert_tracks(
        self,
        *,
        rms_below_mrad: Bound | None = None,
        max_below_mrad: Bound | None = None,
        rms_below_mm: Bound | None = None,
        max_below_mm: Bound | None = None,
    ) -> None:
        """The true position followed the reference: rotary axes in mrad, linear ones in mm.

        Judged as in the summary: after the first half second, up to the last tick.
        """
        __tracebackhide__ = True
        rotary, linear = self._joints("rad"), self._joints("m")
        rms = by_axis("rms_below_mrad", rms_below_mrad, rotary)
        rms |= by_axis("rms_below_mm", rms_below_mm, linear)
        largest = by_axis("max_below_mrad", max_below_mrad, rotary)
        largest |= by_axis("max_below_mm", max_below_mm, linear)
        if not rms | largest:
            raise ValueError("assert_tracks: say how well, as in rms_below_mrad=0.5")
        self._require(
            judge.tracks_badly(self.config, self.summary, self.arrays, rms=rms, largest=largest)
        )

    def assert_estimates(self, *, rms_below_counts: Bound) -> None:
        """The position estimated for each tick's now was the true one, give or take some encoder
        counts. Judged over the same time as the tracking."""
        __tracebackhide__ = True
        encoders = [axis.joint for axis in self.config.machine.boards]
        counts = by_axis("rms_below_counts", rms_below_counts, encoders)
        self._require(
            judge.estimates_badly(self.config, self.summary, self.arrays, rms_counts=counts)
        )

    def assert_comes_to_rest(self, within_s: float | None = None) -> None:
        """At the end every device held and every axis stood still.

        within_s: so long after the last tick each axis was where it ends, and stayed there.
        """
        __tracebackhide__ = True
        self._require(judge.does_not_rest(self.config, self.arrays, within_s))

    def assert_no_deadline_missed(self) -> None:
        """No tick was skipped, and none was too late to send its plan."""
        __tracebackhide__ = True
        self._require(judge.deadlines_missed(self.config, self.summary, self.arrays))

    def assert_no_plan_refused(self) -> None:
        """No device refused a plan, because it was late or for another reason."""
        __tracebackhide__ = True
        self._require(judge.plans_refused(self.config, self.summary, self.arrays))

    def _joints(self, *units: str) -> list[str]:
        return [axis.joint for axis in self.config.machine.axes if axis.unit in units]

    def _require(self, found: list[str]) -> None:
        __tracebackhide__ = True
        if found:
            raise AssertionError("\n".join([*found, f"again: {self.replay}"]))


class ClosedLoop:
    """Runs configs for tests: equal runs once, since they would be the same bit by bit."""

    def __init__(self, current: Path) -> None:
        """current: the folder that commands are given in."""
        self.folders: Sequence[Path] = ()  # where relative paths start: the first that has the file
        self.used: dict[Simulation, str] = {}  # with the command that repeats it; for the user
        self._current = current
        self._cache: dict[str, Simulation] = {}  # the latest come last

    def __call__(
        self,
        config: Path | str,
        overrides: Mapping[str, Any] | None = None,
        /,
        **keys: Any,
    ) -> ClosedLoopRun:
        """Runs a config's task in closed loop, in simulation.

        config: its file, from the test's folder or the root of the tests. overrides: values by
        dotted keys, `{"sim.to_device.loss": 0.1}`; those of the top level may be keyword arguments,
        `duration_s=2, seed=3`. They are checked like `--set`. Raises FileNotFoundError, ConfigError
        with all mistakes, ValueError for a model that does not fit, TypeError for a value that no
        config has, and what ends a run early: DeviceError, UnstableError.
        """
        __tracebackhide__ = True
        try:
            return self._run(self._find(config), changes_of({**(overrides or {}), **keys}))
        except FORESEEN as error:
            raise error.with_traceback(None) from None  # the test's own line says where

    def _find(self, name: Path | str) -> Path:
        paths = list(dict.fromkeys(folder / name for folder in self.folders))
        for path in paths:
            if path.is_file():
                return path
        raise FileNotFoundError(f"there is no config {' or '.join(map(str, paths))}")

    def _run(self, path: Path, changes: list[str]) -> ClosedLoopRun:
        config = load_config(path, changes)
        shown = path.relative_to(self._current) if path.is_relative_to(self._current) else path
        replay = replay_command(shown, changes, config.seed)
        key = _key(config, path.parent)
        simulation = self._cache.pop(key, None) or Simulation(config, path.parent)
        self.used[simulation] = replay
        summary = simulation.summary or simulation.run()
        self._cache[key] = simulation
        if len(self._cache) > CACHED_MAX:
            del self._cache[next(iter(self._cache))]
        arrays = simulation.record.arrays()
        for array in arrays.values():
            array.flags.writeable = False
        return ClosedLoopRun(config, arrays, copy.deepcopy(summary), replay, simulation)


def _key(config: Config, folder: Path) -> str:
    """The same for equal runs."""
    model = (folder / config.machine.model).resolve()
    content = hashlib.sha256(model.read_bytes()).hexdigest()
    return f"{model} {content} {config.model_dump_json()}"
