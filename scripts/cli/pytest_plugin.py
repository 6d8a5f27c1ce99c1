"""The pytest plugin: the fixture `closed_loop`, and the record of runs in tests that fail.

Whoever has Headway installed imports this at each start of pytest, so it imports nothing heavy
before a test asks for the fixture.
"""

from __future__ import annotations

import re
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import pytest

if TYPE_CHECKING:
    from headway.cli.closed_loop import ClosedLoop
    from headway.cli.simulation import Simulation

ITEM = pytest.StashKey[pytest.Item]()  # the test that is under way
BENCH = pytest.StashKey["Bench"]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("headway").addoption(
        "--headway-keep",
        metavar="DIR",
        type=Path,
        help="keep the records of closed_loop runs in failing tests below DIR "
        "(default: below pytest's temporary folder)",
    )


class Bench:
    """The session's closed loop and the records that failing tests leave."""

    def __init__(self, loop: ClosedLoop, keep_in: Path) -> None:
        self.loop = loop
        self._keep_in = keep_in
        self._kept: WeakKeyDictionary[Simulation, Path] = WeakKeyDictionary()  # records are large

    def keep(self, test: str) -> str:
        """Keeps the runs that the test has used; says where they are."""
        return "\n".join(
            f"{self._keep(simulation, test)}\nagain: {replay}"
            for simulation, replay in self.loop.used.items()
        )

    def _keep(self, simulation: Simulation, test: str) -> str:
        try:
            if simulation not in self._kept:
                folder = _new_folder(self._keep_in, f"{test}-{simulation.config.name}")
                simulation.keep(folder)
                self._kept[simulation] = folder
        except OSError as error:
            return f"the run could not be kept: {error}"
        return f"the run is kept in {self._kept[simulation]}"


def _new_folder(base: Path, name: str) -> Path:
    """Makes `name`, or a numbered one beside it. Raises OSError."""
    name = re.sub(r"[^\w.]+", "-", name)[-100:]
    base.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = base / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1


@pytest.fixture(scope="session")
def closed_loop(
    pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory
) -> ClosedLoop:
    """Runs a config in closed loop: closed_loop("arm.yaml", {"sim.to_device.loss": 0.1}, seed=3).

    Gives a ClosedLoopRun: record as arrays, summary, and assertions. Equal runs happen only once.
    """
    from headway.cli.closed_loop import ClosedLoop

    current = pytestconfig.invocation_params.dir
    loop = ClosedLoop(current)
    keep_in = pytestconfig.getoption("--headway-keep")
    keep_in = current / keep_in if keep_in else tmp_path_factory.getbasetemp() / "headway"
    pytestconfig.stash[BENCH] = Bench(loop, keep_in)
    _begin(pytestconfig)
    return loop


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.config.stash[ITEM] = item
    _begin(item.config)


def _begin(config: pytest.Config) -> None:
    """Prepares the closed loop for the test that is under way."""
    if BENCH in config.stash:
        loop = config.stash[BENCH].loop
        loop.folders = config.stash[ITEM].path.parent, config.rootpath
        loop.used.clear()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed and BENCH in item.config.stash:
        bench = item.config.stash[BENCH]
        _use_arguments(item, bench.loop)
        if text := bench.keep(item.nodeid):
            report.sections.append(("headway", text))
    return report


def _use_arguments(item: pytest.Item, loop: ClosedLoop) -> None:
    """A run may come from a fixture that was set up for an earlier test."""
    from headway.cli.closed_loop import ClosedLoopRun

    for value in getattr(item, "funcargs", {}).values():
        if isinstance(value, ClosedLoopRun):
            loop.used.setdefault(value.simulation, value.replay)
