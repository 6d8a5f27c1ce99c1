"""The whole firmware on several boards: in a row behind a host, and around one on a bus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from clocks.exchanges import (
    EPOCH_US,
    KNOT_US,
    REQUEST_BYTES,
    STATUS_BYTES,
    SYNC_BYTES,
    Counter,
    Least,
    bus_of,
    least_of,
)
from clocks.firmware import BOUNDS, settings_of
from headway.configs.load import load_config
from headway.configs.schema import Sync
from headway.devices.bus import Bus as Marks
from headway.devices.settings import device_settings
from headway.firmware import _core
from headway.sim.boards import Boards, Cable, Crystal, End, Host
from headway.sim.bus import Bus
from headway.sim.network import Wire
from headway.sim.profiles import PROFILES

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
CHAIN = 5
UP, DOWN = 1, 2  # a board's ports
PERIOD_US = 1000
POLL_US = 100  # a board has little to do but poll
# An answer counts until the next question: of a network with long delays only the fast ones do.
ASK_US = KNOT_US


B = TypeVar("B", bound=Boards)


class Ran(NamedTuple):
    """At times (m,), of shape (m, boards) each [us]."""

    true_us: NDArray[np.int64]
    error: NDArray[np.float64]  # what a clock shows minus the host's time
    least: NDArray[np.float64]
    most: NDArray[np.float64]
    settled: NDArray[np.bool_]
    excluded: int  # stamps

    @property
    def violations(self) -> NDArray[np.bool_]:
        """Where the truth is outside what was told, whatever rounding the readings have: a count's
        and a clock's microsecond, and a millisecond since it was told."""
        return (self.error + 2.3 < self.least) | (self.error - 0.3 > self.most)


def board_settings(
    profile: str, ports: int, method: int, tuned: dict[str, float] | None
) -> _core.DeviceSettings:
    """Of a board that asks those at its `ports` (a mask): what is known of the wires."""
    config = load_config(CONFIGS / "arm2.yaml", [])
    settings = device_settings(config.machine.axes[0], config.device, config.loop, config.sync)
    channels = PROFILES[profile]
    least = Least(
        least_of(channels.to_device, SYNC_BYTES), least_of(channels.to_host, STATUS_BYTES)
    )
    settings.sync = settings_of(method, least, tuned)
    settings.dither_us = Sync().dither_us  # arm2's own wires need none
    settings.servo_period_us = PERIOD_US
    settings.neighbours, settings.ask_us = ports, ASK_US
    settings.peer_least_us = least_of(channels.to_device, REQUEST_BYTES)
    settings.key = settings.peer_key = bytes(range(16))
    assert settings.valid
    return settings


def _host(
    profile: str, board: int, key: bytes, bus: Bus | None, rng: np.random.Generator,
    marks: Marks | None = None,
) -> Host:  # fmt: skip
    out, home, nonces = rng.spawn(3)
    channels = PROFILES[profile]
    wires = (Wire(channels.to_device, out, bus), Wire(channels.to_host, home, bus))
    return Host(board, key, wires, EPOCH_US, int(rng.integers(KNOT_US)), KNOT_US, nonces, marks)


def chain(
    profile: str,
    method: int,
    rng: np.random.Generator,
    tuned: dict[str, float] | None = None,
    kind: Callable[..., B] = Boards,
) -> B:
    """A row, powered up. Between boards both ways are like the profile's way to a device."""
    bus = bus_of(profile, rng)
    settings = [
        board_settings(profile, (1 << UP) * (i > 0) | (1 << DOWN) * (i < CHAIN - 1), method, tuned)
        for i in range(CHAIN)
    ]
    crystals = [Crystal(*Counter(rng).numbers) for _ in settings]
    cables = []
    for board in range(CHAIN - 1):
        wires = [Wire(PROFILES[profile].to_device, each, bus) for each in rng.spawn(2)]
        cables.append(Cable((End(board, DOWN), End(board + 1, UP)), (wires[0], wires[1])))
    host = _host(profile, 0, settings[0].key, bus, rng)
    return kind(settings, crystals, cables, rng.spawn(1)[0], [host], None, POLL_US)


def star(profile: str, boards: int, rng: np.random.Generator, marked: bool) -> Boards:
    """Around a host, powered up. With `marked` all see the starts of the bus's frames."""
    bus = bus_of(profile, rng)
    marks = Marks(boards) if marked else None
    settings = [board_settings(profile, 0, BOUNDS, None) for _ in range(boards)]
    crystals = [Crystal(*Counter(rng).numbers) for _ in settings]
    hosts = [_host(profile, i, settings[i].key, bus, rng, marks) for i in range(boards)]
    return Boards(settings, crystals, [], rng.spawn(1)[0], hosts, bus if marked else None, POLL_US)


def run(boards: Boards, duration_us: int, every_us: int = PERIOD_US) -> Ran:
    """From power-up on, seen each `every_us`."""
    shown, told, settled = [], [], []
    true_us = np.arange(every_us, duration_us + 1, every_us)
    for now_us in true_us.tolist():
        boards.advance(now_us)
        shown.append([us - now_us - EPOCH_US for us in boards.shown_us()])
        told.append(boards.told_ns())
        settled.append([node.synced for node in boards.nodes])
    unknown = np.iinfo(np.int32).max
    bounds = np.array(told, dtype=np.int64)
    bounds_us = np.where(np.abs(bounds) >= unknown, np.nan, bounds * 1e-3)
    excluded = sum(node.status.stamps_excluded for node in boards.nodes)
    return Ran(
        true_us, np.array(shown, dtype=float), bounds_us[:, :, 0], bounds_us[:, :, 1],
        np.array(settled), excluded,
    )  # fmt: skip
