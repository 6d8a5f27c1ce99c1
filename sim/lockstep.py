"""The closed loop in lockstep virtual time: plant, devices, network and controller in one process.

True time counts physics steps. The host's clock is true time plus an epoch, the devices' counters
have offsets and drifts of their own; nobody but this module and the board's oscillator sees true
time. A tick at time t costs `compute_us`: what it sends leaves at t + compute_us.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.estimator import Sample
from headway.controller.loop import Loop, Phase, Tick
from headway.controller.reference import Sines
from headway.devices.axis import device_settings
from headway.devices.core import COAST_KNOTS
from headway.devices.remote import Remote
from headway.firmware import _core
from headway.models.machine import load_machine
from headway.sim.network import Mailbox, Wire
from headway.sim.plant import Plant
from headway.sim.record import Record

TRUTH_US = 1000
REST_S = 1.0  # simulated after the last plan's end, to see the machine come to rest


class SimLink:
    """The simulated network as the loop sees it."""

    def __init__(
        self, config: Config, plant: Plant, epoch_us: int, seeds: list[np.random.Generator]
    ):
        n = len(plant.nodes)
        self._plant, self._epoch_us, self._mailbox = plant, epoch_us, Mailbox()
        self.to_device = [Wire(config.sim.to_device, rng) for rng in seeds[:n]]
        self.to_host = [Wire(config.sim.to_host, rng) for rng in seeds[n : 2 * n]]

    def count_anew(self) -> None:
        """From here on, frames are counted from zero."""
        for wire in (*self.to_device, *self.to_host):
            wire.sent = wire.lost = 0

    def collect(self) -> None:
        """Puts what the devices have sent on its way to the host."""
        for device, node in enumerate(self._plant.nodes):
            for sent_us, packet in node.collect():
                arrival_us = self.to_host[device].carry(sent_us)
                if arrival_us is not None:
                    self._mailbox.put(arrival_us + self._epoch_us, device, packet)

    def receive(self, now_us: int) -> list[tuple[int, int, bytes]]:
        return self._mailbox.take(now_us)

    def send(self, device: int, packet: bytes, now_us: int) -> None:
        arrival_us = self.to_device[device].carry(now_us - self._epoch_us)
        if arrival_us is not None:
            self._plant.nodes[device].deliver(arrival_us, packet)


class Lockstep:
    """One machine in closed loop, from power-up to rest."""

    def __init__(self, config: Config, folder: Path) -> None:
        """`folder` is where the config's relative paths start. Raises ValueError for mistakes."""
        self.config = config
        path = (folder / config.machine.model).resolve()
        if not path.is_file():
            raise ValueError(f"machine.model: there is no file {path}")
        n = len(config.machine.axes)
        root = np.random.SeedSequence(config.seed)
        world, outliers, *wires = (np.random.default_rng(s) for s in root.spawn(2 + 2 * n))
        self._outlier_rng = outliers
        self.plant = Plant(path, config.machine, config.sim.plant)
        self.epoch_us = int(world.integers(10**15, 2 * 10**15))
        self.link = SimLink(config, self.plant, self.epoch_us, wires)
        reference = Sines(config.task)
        start = config.sim.start_rad or reference.at(np.zeros(1))[0][0]
        self.plant.position = np.array(start)
        remotes = [self._power_up(device, world) for device in range(n)]
        self.remotes = remotes
        self.reference = reference
        self.loop = Loop(config, load_machine(path), remotes, reference)
        self.record = Record()
        self.ticks = self.deadline_misses = 0
        self.stopping = False  # set it to end the run early: the last plan brings all to rest
        self._busy_until_us = 0

    def _power_up(self, device: int, world: np.random.Generator) -> Remote:
        """Flashes a board with its settings, a key and an oscillator of its own."""
        config = self.config
        settings = device_settings(config.machine.axes[device], config.device, config.loop)
        key, settings.session = world.bytes(16), device + 1
        settings.key = key
        drift_ppb = round(world.uniform(-1, 1) * config.sim.clocks.drift_ppm * 1000)
        self.plant.nodes[device].flash(settings, int(world.integers(2**32)), drift_ppb)
        return Remote(key, device + 1, COAST_KNOTS * config.loop.knot_us)

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """From power-up through the task's duration to rest; `progress` gets seconds of the task.

        Raises DeviceError if a device does not answer or does not start.
        """
        knot_us = self.config.loop.knot_us
        now_us = -(-(self.epoch_us + self.plant.true_us) // knot_us) * knot_us
        end_us: int | None = None
        while not self.stopping and (end_us is None or now_us < end_us):
            self._advance_to(now_us - self.epoch_us)
            self._host_tick(now_us)
            now_us += knot_us
            if self.loop.phase is Phase.RUN and end_us is None:
                end_us = self.loop.start_us + round(self.config.duration_s * 1e6)
                self.link.count_anew()
            if progress and end_us is not None and self.ticks % 64 == 0:
                progress((now_us - self.loop.start_us) * 1e-6)
        self.end_us = now_us
        plan_us = self.config.mpc.horizon_us + self.config.loop.margin_us
        self._advance_to(now_us - self.epoch_us + plan_us + round(REST_S * 1e6))

    def task_s(self, system_us: int) -> float:
        """Time of the task at a system time."""
        return (system_us - self.loop.start_us) * 1e-6

    def _host_tick(self, now_us: int) -> None:
        sim = self.config.sim
        running = self.loop.phase is Phase.RUN
        task_s = self.task_s(now_us) if running else -1.0
        kill_s = np.inf if sim.kill_host_at_s is None else sim.kill_host_at_s
        if task_s >= kill_s:
            return
        if now_us < self._busy_until_us:  # the last tick is still at work: this one is skipped
            self.deadline_misses += running
            return
        compute_us = sim.compute_us
        stall = sim.stall_host_at_s
        if stall is not None and stall <= task_s < stall + self.config.loop.knot_us * 1e-6:
            compute_us += round(sim.stall_host_s * 1e6)
        self.loop.read(self.link, now_us)
        self._corrupt(self.loop.samples)
        tick, outbox = self.loop.tick(now_us)
        sent_us = self._busy_until_us = now_us + compute_us
        if running and self.task_s(sent_us) >= kill_s:  # it died at work
            return
        in_time = self.loop.write(self.link, outbox, sent_us)
        self.deadline_misses += running and not in_time
        if tick.phase is Phase.RUN:
            self.ticks += 1
            self._note(tick)

    def _corrupt(self, samples: list[Sample]) -> None:
        share = self.config.sim.outlier_share
        if share == 0:
            return
        for i, sample in enumerate(samples):
            if self._outlier_rng.random() < share:
                off = self._outlier_rng.uniform(-1, 1)
                samples[i] = Sample(sample.time_us, sample.axis, sample.position_rad + off)

    def _advance_to(self, true_us: int) -> None:
        """Steps the plant to the first step at or after `true_us`, noting the truth each ms."""
        step_us, plant = self.plant.step_us, self.plant
        while plant.true_us < true_us:
            next_truth_us = (plant.true_us // TRUTH_US + 1) * TRUTH_US
            target_us = min(next_truth_us, true_us)
            plant.step(-(-(target_us - plant.true_us) // step_us))
            if self.loop.phase is Phase.RUN and plant.true_us % TRUTH_US == 0:
                self._note_truth(plant.true_us)
        self.link.collect()

    def _note_truth(self, true_us: int) -> None:
        """True motion; and the state at that time as the reference has it."""
        add, plant = self.record.add, self.plant
        time_s = self.task_s(true_us + self.epoch_us)
        add("truth_s", time_s)
        add("truth_position", plant.position)
        add("truth_velocity", plant.velocity)
        add("truth_torque", plant.torque)
        add("truth_reference", self.reference.at(np.array([time_s]))[0][0])
        setpoints = [node.setpoint(true_us + self.epoch_us) for node in plant.nodes]
        add("setpoint", [v for setpoint in setpoints for v in setpoint])
        add("servo_torque_tq", [node.torque_tq for node in plant.nodes])
        add("servo_unclipped_tq", [node.unclipped_tq for node in plant.nodes])

    def _note(self, tick: Tick) -> None:
        add, nan = self.record.add, np.nan
        n = len(self.remotes)
        add("tick_s", self.task_s(tick.now_us))
        add("tick_true_position", self.plant.position)
        add("tick_true_velocity", self.plant.velocity)
        add("tick_samples", tick.samples)
        add("tick_states", tick.states)
        for name, estimate in (("now", tick.now), ("commit", tick.commit)):
            assert estimate is not None
            add(f"{name}_s", self.task_s(estimate.time_us))
            add(f"{name}_estimate", estimate.z)
            add(f"{name}_sigma", np.sqrt(np.diag(estimate.covariance)))
        add("accepted", tick.accepted)
        solution = tick.solution
        add("iterations", solution.iterations if solution else nan)
        add("residual", solution.residual if solution else nan)
        empty: NDArray[np.float64] = np.full(n, nan)
        add("encoding_error", empty if tick.encoding_error is None else tick.encoding_error)
        add("planned_torque", empty if tick.planned_torque is None else tick.planned_torque)
        add("compute_us", tick.total_us)
        add("estimate_us", tick.estimate_us)
        add("linearize_us", solution.linearize_us if solution else nan)
        add("solve_us", solution.solve_us if solution else nan)
        add("encode_us", tick.encode_us)

    def device_states(self) -> list[str]:
        """State of every device, by name, as the simulator sees it."""
        return [_core.STATES[node.state] for node in self.plant.nodes]
