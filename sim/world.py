"""A simulated machine at power-up: the plant, its boards, their wires, and the host's ends."""

from __future__ import annotations

import secrets
from pathlib import Path

import numpy as np

from headway.configs.schema import Config
from headway.controller.reference import task_reference
from headway.devices.axis import TURN
from headway.devices.bus import Bus as Marks
from headway.devices.core import COAST_KNOTS
from headway.devices.keys import Keys
from headway.devices.remote import Remote
from headway.devices.session import Session
from headway.devices.settings import device_settings
from headway.sim.link import SimLink
from headway.sim.plant import Plant, start_of


class World:
    """All that a config's seed decides. Raises ValueError for mistakes."""

    def __init__(
        self,
        config: Config,
        folder: Path,
        keys: Keys | None = None,
    ) -> None:
        """`folder` is where the config's relative paths start. `keys` are drawn by the seed if they
        are not given."""
        self.config, self._keys = config, keys
        self.model = (folder / config.machine.model).resolve()
        n = len(config.machine.boards)
        seeds = np.random.SeedSequence(config.seed).spawn(4 + 2 * n)
        world, outliers, *wires, nonces, clocks = (np.random.default_rng(s) for s in seeds)
        self.outliers = outliers  # draws which samples are replaced by nonsense
        self.reference = task_reference(config, folder)
        start = start_of(config, self.reference)
        period_us = config.device.servo_period_us
        self.plant = Plant(self.model, config.machine, config.sim.plant, period_us, start)
        self.plant.set_bridge(config.sim.bridge_F)
        self.link = SimLink(
            config, self.plant, int(world.integers(10**15, 2 * 10**15)), [*wires, clocks]
        )
        self._marks = Marks(n) if config.sync.one_bus else None
        self.remotes = [self._power_up(device, world, nonces, clocks) for device in range(n)]

    def _power_up(
        self,
        device: int,
        world: np.random.Generator,
        nonces: np.random.Generator,
        wander: np.random.Generator,
    ) -> Remote:
        """Flashes a board with its settings, a key and an oscillator of its own."""
        config, axis = self.config, self.config.machine.boards[device]
        settings = device_settings(axis, config.device, config.loop, config.sync)
        settings.key = world.bytes(16)
        if self._keys is not None:
            settings.key = self._keys.devices[axis.joint]
            settings.peer_key = self._keys.sync
        if axis.homing is not None:
            self._forget(device, world)
        clocks, node = config.sim.clocks, self.plant.nodes[device]
        bound_ppb = round(clocks.drift_ppm * 1000)
        node.flash(
            settings,
            count_offset=int(world.integers(2**32)),
            drift_ppb=round(world.uniform(-1, 1) * bound_ppb),
            wander_ppb_per_s=round(clocks.wander_ppm_per_s * 1000),
            drift_bound_ppb=bound_ppb,
            oscillator_seed=int(wander.integers(2**63)),
        )
        node.random = int(nonces.integers(2**63))
        if self._keys is not None:  # a key that others have too: no nonce of a seed may come again
            node.random = secrets.randbits(64)
        if self.link.bus is not None:
            bus = self.link.bus
            node.join_bus(bus.phase_ps, bus.period_ps, int(wander.integers(2**63)))
        patience_us = COAST_KNOTS * config.loop.knot_us
        return Remote(Session(settings.key, nonces), patience_us, device, self._marks)

    def _forget(self, device: int, world: np.random.Generator) -> None:
        """An encoder that counts from where it is at power-up; its marks are at their places."""
        node, axis = self.plant.nodes[device], self.config.machine.boards[device]
        assert axis.homing is not None
        turn = round(axis.counts_per_unit * axis.motor.turn)
        mark = round(axis.homing.mark * axis.counts_per_unit)
        node.encoder_offset = int(world.integers(-turn, turn))
        node.index_every, node.index_at = turn, mark
        beyond = (-(2**31), mark) if axis.homing.backwards else (mark, 2**31 - 1)
        if axis.continuous:  # a cam over half of each turn
            around = round(axis.counts_per_unit * TURN)
            half = -around // 2 if axis.homing.backwards else around // 2
            beyond = min(mark, mark + half), max(mark, mark + half)
            node.switch_every = around
        node.switch_from, node.switch_to = beyond
