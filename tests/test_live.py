"""The loop on a clock of its own, in virtual time: a clock that steps the simulated plant.

So the loop that runs on the wall clock is the one judged here, and it cannot tell.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from headway.cli.summary import summarize
from headway.configs.load import load_config
from headway.controller.live import Live
from headway.controller.loop import Loop
from headway.controller.record.recorder import Memory
from headway.controller.tick import DeviceError, Phase
from headway.models.machine import load_machine
from headway.sim.plant_clock import PlantClock
from headway.sim.world import World

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
KNOT_US = 4096


class Bench:
    """A clock in whose time a plant moves. `oversleep(time_us)`: what a wait is late by."""

    def __init__(self, oversleep: Callable[[int], int] = lambda _: 0, *changes: str) -> None:
        config = load_config(CONFIGS / "arm2.yaml", ["duration_s=0.7", *changes])
        self.world = World(config, CONFIGS)
        self.clock = PlantClock(self.world)
        self.oversleep, self.record = oversleep, Memory()
        self.positions: list[np.ndarray] = []
        loop = Loop(
            config, load_machine(self.world.model), self.world.remotes, self.world.reference,
            self.record,
        )  # fmt: skip
        self.live = Live(config, loop, self.world.remotes, self.world.link, self.record, self)

    def now_us(self) -> int:
        return self.clock.now_us()

    def wait_until(self, time_us: int) -> None:
        time_us += self.oversleep(time_us)
        while self.now_us() < time_us:
            self.clock.wait_until(min(self.now_us() + 1000, time_us))
            self.positions.append(self.world.plant.position.copy())

    @property
    def task_s(self) -> float:
        return (self.now_us() - self.live.loop.start_us) * 1e-6

    def at(self, second: float, late_us: int) -> None:
        """One wait of the task oversleeps."""
        done = [False]

        def once(time_us: int) -> int:
            task = self.live.loop.phase is Phase.RUN
            if done[0] or not task or (time_us - self.live.loop.start_us) * 1e-6 < second:
                return 0
            done[0] = True
            return late_us

        self.oversleep = once


def test_it_follows_and_rests() -> None:
    bench = Bench()
    bench.live.run()
    assert bench.live.device_states() == ["HOLD", "HOLD"]
    assert bench.live.deadline_misses == 0
    assert bench.live.ticks == pytest.approx(0.7e6 / KNOT_US, abs=2)
    arrays = bench.record.arrays()
    assert np.all(np.diff(arrays["tick_us"]) == KNOT_US)
    assert arrays["tick_accepted"].all() and arrays["end_ticks"].tolist() == [bench.live.ticks]


@pytest.mark.parametrize(
    ("late_us", "skipped"),
    [(1700, 0), (2200, 1), (3700, 1), (5800, 2), (7500, 2), (18_000, 5), (30_000, 11)],
)
def test_a_late_tick_is_skipped_and_counted(late_us: int, skipped: int) -> None:
    """Beyond half a knot it is; and no tick follows another by less than a knot."""
    bench = Bench()
    bench.at(0.3, late_us)
    bench.live.run()
    gaps = np.diff(bench.record.arrays()["tick_us"])
    assert sorted(set(gaps.tolist())) == sorted({KNOT_US, KNOT_US * (skipped + 1)})
    assert bench.live.deadline_misses >= skipped
    assert bench.live.deadline_misses - skipped <= (late_us < 2048)  # a plan too late, at most
    assert bench.live.device_states() == ["HOLD", "HOLD"]


def test_a_pause_longer_than_the_plan_ends_the_run_at_rest() -> None:
    bench = Bench(lambda _: 0, "duration_s=2")
    bench.at(0.5, 700_000)
    with pytest.raises(DeviceError, match="came to rest and holds: no plan reached it"):
        bench.live.run()
    assert bench.live.device_states() == ["HOLD", "HOLD"]
    still = np.ptp(np.array(bench.positions)[-50:], axis=0)
    assert np.all(still < 1e-3)


@pytest.mark.parametrize("phase", [Phase.SYNC, Phase.ARM, Phase.START, Phase.RUN])
def test_a_stop_in_any_phase_leaves_nobody_armed(phase: Phase) -> None:
    bench = Bench()

    def stop(_: int) -> int:
        bench.live.stopping |= bench.live.loop.phase is phase
        return 0

    bench.oversleep = stop
    bench.live.run()
    resting = {Phase.SYNC: {"UNSYNCED", "IDLE"}, Phase.ARM: {"IDLE"}}.get(phase, {"HOLD"})
    assert set(bench.live.device_states()) <= resting
    assert bench.live.ticks == 0


def test_a_device_that_falls_silent_ends_it() -> None:
    bench = Bench()

    def cut(_: int) -> int:
        if bench.live.loop.phase is Phase.RUN and bench.task_s > 0.4:
            bench.world.link.cut({1})
        return 0

    bench.oversleep = cut
    with pytest.raises(DeviceError, match="q2: the device no longer answers"):
        bench.live.run()
    assert [node.state for node in bench.world.plant.nodes] == [7, 7]


def test_any_task_is_summed_up_without_the_truth() -> None:
    """By what the encoders told, as of a machine that nobody sees from outside."""
    bench = Bench(
        lambda _: 0,
        "task={kind: regulate, target_rad_or_m: [1.0, 0.5]}",
        "sim.start_rad_or_m=[0.9, 0.6]",
    )
    bench.live.run()
    config, arrays = bench.live.config, bench.record.arrays()
    tracking = summarize(config, bench.live, arrays)["tracking"]
    assert tracking["by"] == "encoders" and max(tracking["max"]) < 2
