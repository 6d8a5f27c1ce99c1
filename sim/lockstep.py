"""The closed loop in lockstep virtual time: plant, devices, network and controller in one process.

True time counts physics steps. The host's clock is true time plus an epoch, the devices' counters
have offsets and drifts of their own; nobody but this module, the network and the board's oscillator
sees true time. A tick at time t costs `compute_us`: what it sends leaves at t + compute_us.

Ticks lie on knots of the host's clock. When that jumps, the next one is at the first knot that it
then shows; the task goes on for its duration in true time, and may see a time twice.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.loop import Loop
from headway.controller.record.columns import Arrays
from headway.controller.record.note import note_tick
from headway.controller.record.recorder import Memory, Recorder
from headway.controller.tick import DeviceError, Phase
from headway.devices._tracks import Sample, Samples
from headway.firmware import _core
from headway.models.machine import load_machine
from headway.sim.mishaps import Mishaps
from headway.sim.truth import TRUTH_US, note_truth
from headway.sim.world import World

REST_S = 1.0  # simulated after the last plan's end, to see the machine come to rest


class Lockstep:
    """One machine in closed loop, from power-up to rest."""

    def __init__(self, config: Config, folder: Path, record: Recorder | None = None) -> None:
        """`folder` is where the config's relative paths start; `record` is by default in memory.

        Raises ValueError for mistakes.
        """
        world = World(config, folder)
        self.config, self.plant, self.link = config, world.plant, world.link
        self.remotes, self.reference = world.remotes, world.reference
        self._outlier_rng = world.outliers
        self.record = record or Memory()
        machine = load_machine(world.model, config.machine.coupling)
        self.loop = Loop(config, machine, self.remotes, self.reference, self.record)
        self.ticks = self.deadline_misses = 0
        self.stopping = False  # set it to end the run early: the last plan brings all to rest
        self._busy_until_us = 0  # true time, as the two below
        self._last_us = 0  # when the tick after the last one would have been due
        self._begun_us: int | None = None  # when the task began
        self._mishaps = Mishaps(config, self.plant, self.link) if config.sim.mishaps else None

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """From power-up through the task's duration to rest; after each tick of the task `progress`
        gets its seconds.

        Raises DeviceError if a device does not answer, does not start or stops by itself; by then
        all have come to rest.
        """
        try:
            self._run_task(progress)
        except DeviceError:
            self._come_to_rest()
            raise
        self._come_to_rest()

    def _run_task(self, progress: Callable[[float], None] | None) -> None:
        knot_us = self.config.loop.knot_us
        now_us = self._next_knot()
        end_us: int | None = None  # true time
        while not self.stopping and (end_us is None or now_us - self.epoch_us < end_us):
            epoch_us = self.epoch_us
            self._advance_to(now_us - epoch_us)
            if self.epoch_us != epoch_us:  # the host's clock has jumped: it waits for another knot
                now_us = self._next_knot()
                continue
            self._host_tick(now_us)
            now_us += knot_us
            self._last_us = now_us - self.epoch_us
            if self.loop.phase is Phase.RUN and end_us is None:
                self.record.add(("task", now_us, (self.loop.start_us,)))
                self._begun_us = self.loop.start_us - self.epoch_us
                end_us = self._begun_us + round(self.config.duration_s * 1e6)
                self.link.count_anew()
            if progress and end_us is not None:
                progress(self.elapsed_s(now_us - self.epoch_us))

    def _next_knot(self) -> int:
        """The first knot from now on, in the host's time."""
        knot_us = self.config.loop.knot_us
        return -(-(self.epoch_us + self.plant.true_us) // knot_us) * knot_us

    def _come_to_rest(self) -> None:
        plan_us = self.config.mpc.horizon_us + self.config.loop.margin_us
        rest_us = self._last_us + plan_us + round(REST_S * 1e6)
        while self.plant.true_us < rest_us:
            self._advance_to(rest_us)
        self._note_end()

    @property
    def epoch_us(self) -> int:
        """The host's time at true time 0, as its clock has it now."""
        return self.link.epoch_us

    def task_s(self, system_us: int | NDArray[np.int64]) -> Any:
        """Time of the task at a system time, or at several."""
        return (system_us - self.loop.start_us) * 1e-6

    def elapsed_s(self, true_us: int) -> float:
        """True time since the task began, whatever the host's clock says; -1 before."""
        return -1.0 if self._begun_us is None else (true_us - self._begun_us) * 1e-6

    def _host_tick(self, now_us: int) -> None:
        sim = self.config.sim
        running = self.loop.phase is Phase.RUN
        true_us = now_us - self.epoch_us
        task_s = self.elapsed_s(true_us) if running else -1.0
        kill_s = np.inf if sim.kill_host_at_s is None else sim.kill_host_at_s
        if task_s >= kill_s:
            return
        if true_us < self._busy_until_us:  # the last tick is still at work: this one is skipped
            self.deadline_misses += running
            return
        compute_us = sim.compute_us
        stall = sim.stall_host_at_s
        if stall is not None and stall <= task_s < stall + self.config.loop.knot_us * 1e-6:
            compute_us += round(sim.stall_host_s * 1e6)
        self.loop.read(self.link, now_us)
        self._corrupt(self.loop.samples, now_us)
        tick, outbox = self.loop.tick(now_us)
        sent_us = now_us + compute_us
        self._busy_until_us = true_us + compute_us
        if running and task_s + compute_us * 1e-6 >= kill_s:  # it died at work
            return
        in_time = self.loop.write(self.link, outbox, sent_us)
        self.deadline_misses += running and not in_time
        if running:
            self.ticks += 1
            self.record.add(("actual", now_us, (self.plant.position, self.plant.velocity)))
        note_tick(self.record, tick, sent_us, in_time)
        self.record.await_room()

    def _corrupt(self, samples: Samples, now_us: int) -> None:
        share = self.config.sim.outlier_share
        if share == 0:
            return
        for i, sample in enumerate(samples):
            if self._outlier_rng.random() < share:
                position = sample.position + self._outlier_rng.uniform(-1, 1)
                samples[i] = Sample(sample.time_us, sample.axis, position)
                self.record.add(("outlier", now_us, (i, sample.time_us, sample.axis, position)))

    def _advance_to(self, true_us: int) -> None:
        """Steps the plant to the first step at or after `true_us`, noting the truth each ms; or to
        a jump of the host's clock, if that comes first."""
        step_us, plant, epoch_us = self.plant.step_us, self.plant, self.epoch_us
        noting = self.loop.phase is Phase.RUN
        first_us = (plant.true_us // TRUTH_US + 1) * TRUTH_US
        if noting:  # all at once: numpy's calls cost more than its numbers
            noted_us = np.arange(first_us, true_us + step_us, TRUTH_US)
            wanted = self.reference.at(self.task_s(noted_us + epoch_us))[0]
        now_us = plant.true_us
        while now_us < true_us:
            if self._mishaps and noting:
                self._mishaps.happen(now_us, self.elapsed_s(now_us))
                if self.epoch_us != epoch_us:
                    break
            target_us = min((now_us // TRUTH_US + 1) * TRUTH_US, true_us)
            plant.step(-(-(target_us - now_us) // step_us))
            now_us = plant.true_us
            if noting and now_us % TRUTH_US == 0:
                at = wanted[(now_us - first_us) // TRUTH_US]  # what the reference has then
                note_truth(self.record, plant, now_us + self.epoch_us, at)
        if noting:
            self._publish()
        self.link.collect()

    def _note_end(self) -> None:
        """What the devices and the wires have counted."""
        statuses = [node.status for node in self.plant.nodes]
        counts = (
            self.ticks,
            self.deadline_misses,
            sum(wire.sent for wire in self.link.to_device),
            sum(wire.lost for wire in self.link.to_device),
            sum(status.plans_late for status in statuses),
            sum(status.plans_refused for status in statuses),
            [node.state for node in self.plant.nodes],
        )
        self.record.add(("end", self.plant.true_us + self.epoch_us, counts))
        self._publish()

    def _publish(self) -> None:
        """Time stands still until the record has taken it all."""
        self.record.publish()
        self.record.await_room()

    def frames(self, _: Arrays) -> dict[str, int | None]:
        """Frames from the host to the devices while the task ran, and what the devices refused."""
        statuses = [node.status for node in self.plant.nodes]
        return {
            "sent": sum(wire.sent for wire in self.link.to_device),
            "lost": sum(wire.lost for wire in self.link.to_device),
            "late_points": sum(status.plans_late for status in statuses),
            "gate_refused": sum(status.plans_refused for status in statuses),
        }

    def device_states(self) -> list[str]:
        """State of every device, by name, as the simulator sees it."""
        return [_core.STATES[node.state] for node in self.plant.nodes]
