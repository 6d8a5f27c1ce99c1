"""A stage in simulation: boards with oscillators and wires of their own, playing signals."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from headway.configs.stage import INPUTS, TWO, Sensor, Stage, Track, order
from headway.devices.signals import Logic, Piece, Signals, event
from headway.firmware import _core
from headway.sim.boards import Boards, Cable, Crystal, End, Host
from headway.sim.network import Wire

EPOCH_US = 1_700_000_000_000_000
KNOT_SHIFT = 12
ASK_US = 16_000  # from one question to a board beside to the next
STEP_US = 250  # from one look at the outputs to the next
AFTER_US = 200_000  # that the boards play on, so that the last readings arrive


def pieces(track: Track, begin_us: int, end_us: int) -> list[Piece]:
    """Of a track, in system time: those that start before the end."""
    stream = track.stream
    if stream is not None:
        events = [
            e
            for i in range(stream.times)
            for at in [begin_us + stream.start_us + i * stream.every_us]
            for e in (event(at, stream.value), event(at + stream.on_us, 0))
        ]
        return [e for e in events if e.end_us < end_us]
    found: list[Piece] = []
    for ramp in track.ramps:
        start_us = None if ramp.start_us is None else begin_us + ramp.start_us
        if (found[-1].end_us if start_us is None else start_us) >= end_us:
            break
        found.append(Piece(begin_us + ramp.end_us, ramp.last, start_us, ramp.first))
    return found


def wave(sensor: Sensor, time_us: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a sensor shows at true times [counts]."""
    angle = 2 * np.pi * time_us / sensor.period_us
    made: NDArray[np.float64] = sensor.amplitude * np.sin(angle) + sensor.second * np.cos(2 * angle)
    return made


def board_settings(stage: Stage) -> _core.DeviceSettings:
    """Of a board whose axis never moves: limits that hold whatever its encoder shows."""
    from headway.devices.settings import sync_settings

    servo, monitor = _core.ServoSettings(), _core.MonitorSettings()
    servo.torque_limit_tq = 1
    monitor.following_pq = monitor.speed_pq = monitor.stuck_pq = 1 << 30
    monitor.deceleration_q16 = monitor.rise_q16 = 1 << 30
    monitor.spike_counts, monitor.late_us = (1 << 18) - 1, 4 * stage.servo_period_us
    monitor.supply_max_mV, monitor.chopper_mV = 40_000, 30_000
    home = _core.HomeSettings()
    home.acceleration_q16 = 1
    settings = _core.DeviceSettings()
    settings.key = bytes(range(16))
    settings.servo, settings.monitor, settings.home = servo, monitor, home
    settings.knot_shift, settings.servo_period_us = KNOT_SHIFT, stage.servo_period_us
    settings.sample_every, settings.torque_step_tq = 1, 1
    settings.sync_lost_us, settings.stop_us = 400_000, 300_000
    settings.sync = sync_settings(stage.sync)
    settings.peer_key, settings.ask_us = bytes(range(50, 66)), ASK_US
    return settings


def cables(stage: Stage) -> list[Cable]:
    """Between devices of which one reads what the other feeds, each by the lowest ports left."""
    names, rng = list(stage.devices), np.random.default_rng([stage.seed, 1])
    ports, made = dict.fromkeys(names, 0), []
    for pair in stage.cables:
        for name in pair:
            ports[name] += 1
        ends = [End(names.index(name), ports[name]) for name in pair]
        wires = [Wire(stage.mesh, each) for each in rng.spawn(2)]
        made.append(Cable((ends[0], ends[1]), (wires[0], wires[1])))
    return made


class Play:
    """The boards of a stage, played from power-up to the end. Times are the host's, from the
    begin of the play [us]."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.names = list(stage.devices)
        rng = np.random.default_rng(stage.seed)
        settings = [board_settings(stage) for _ in self.names]
        self.cables = cables(stage)
        for cable in self.cables:
            for end in cable.ends:
                settings[end.board].neighbours |= 1 << end.port
        hosts = [
            Host(
                i,
                settings[i].key,
                (Wire(stage.wire, rng.spawn(1)[0]), Wire(stage.wire, rng.spawn(1)[0])),
                EPOCH_US,
                37 * i,
                1 << KNOT_SHIFT,
                rng.spawn(1)[0],
            )
            for i in range(len(self.names))
        ]
        crystals = [
            Crystal(int(rng.integers(2**32)), round(1000 * d.drift_ppm), 300, 250_000, i)
            for i, d in enumerate(stage.devices.values())
        ]
        self.boards = Boards(settings, crystals, self.cables, rng, hosts, poll_us=250)
        self.widest_us = 0.0  # of what any board told that its clock may be off while it played
        for i, device in enumerate(stage.devices.values()):
            if device.sensor is not None:
                self.boards.encoders[i] = self._encoder(device.sensor)

    @staticmethod
    def _encoder(sensor: Sensor):  # type: ignore[no-untyped-def]
        return lambda true_us: int(np.rint(wave(sensor, np.array([float(true_us)]))[0]))

    def run(self) -> None:
        """To the end. Raises ValueError, with the device's name, for clocks that do not settle, and
        for outputs that change faster than they are looked at."""
        begin_us = round(self.stage.settle_s * 1e6)
        self.boards.advance(begin_us - 500_000)
        for name, node in zip(self.names, self.boards.nodes, strict=True):
            if not node.synced:
                raise ValueError(
                    f"the clock of {name} has not settled within settle_s: {self.stage.settle_s:g}"
                )
        self._begin_us = begin_us
        self._end_us = begin_us + round(self.stage.duration_s * 1e6) + AFTER_US
        for i, name in enumerate(self.names):
            self._hand_out(i, name)
        self.fired: list[dict[int, list[int]]] = [{} for _ in self.names]
        self._looked = [0] * len(self.names)
        for now_us in range(begin_us, self._end_us, STEP_US):
            self.boards.advance(now_us)
            told = [max(-low, high) / 1000 for low, high in self.boards.told_ns()]
            self.widest_us = max(self.widest_us, *told)
            for i in range(len(self.names)):
                self._look(i, now_us)

    def _look(self, index: int, now_us: int) -> None:
        """Notes which outputs have gone on. What is yet to come may be forgotten: it waits."""
        try:
            flips = self.boards.nodes[index].flips_from(self._looked[index])
        except ValueError as error:
            raise ValueError(
                f"the outputs of {self.names[index]} change too fast: {error}"
            ) from error
        for time_us, output, on in flips:
            if time_us > now_us and output >= 0:
                break
            self._looked[index] += 1
            if on and output >= 0:
                self.fired[index].setdefault(output, []).append(time_us - self._begin_us)

    def readings(self, device: int, trigger: int) -> NDArray[np.int64]:
        """Times and values (n, 2)."""
        signals = self.boards.hosts[device].remote.signals
        begin_us = EPOCH_US + self._begin_us
        told = [(t - begin_us, value) for t, value, of in signals.readings if of == trigger]
        return np.array(told, dtype=np.int64).reshape(-1, 2)

    def signals(self, device: int) -> Signals:
        """As the host has them: what was late, refused and lost, and whether the device has all."""
        return self.boards.hosts[device].remote.signals

    def _hand_out(self, index: int, name: str) -> None:
        device, signals = self.stage.devices[name], self.boards.hosts[index].remote.signals
        number = {feed: i for i, feed in enumerate(self.stage.feeds)}
        nodes = order(device.nodes)
        tracks = [*self.stage.tracks, *self.stage.feeds]
        source = {t: _core.SOURCE_OF_PIECES + i for i, t in enumerate(tracks)}
        source |= {n: _core.SOURCE_OF_INPUTS + i for i, n in enumerate(INPUTS)}
        source |= {n: _core.SOURCE_OF_NODES + i for i, n in enumerate(nodes)}
        made = [
            (
                _core.NODE_KINDS.index(node.kind),
                source[node.a],
                source.get(node.b, 0) if node.kind in TWO else 0,
                *((node.low, node.high) if node.by_us is None else (node.by_us, node.otherwise)),
            )
            for node in (device.nodes[n] for n in nodes)
        ]
        triggers = [
            (
                _core.TRIGGER_KINDS.index(r.kind),
                source[r.read],
                source.get(r.when, 0),
                r.every,
            )
            for r in device.readings
        ]
        signals.rule(
            Logic(
                made,
                [source[n] for n in device.digital],
                [source[n] for n in device.pwm],
                triggers,
                nodes,
                [
                    (
                        _core.FEED_KINDS.index(f.kind),
                        source[f.of],
                        number[feed],
                        f.every,
                        f.after_us,
                    )
                    for feed, f in device.feeds.items()
                ],
                [(source[feed], number[feed]) for feed in number if feed in device.uses],
            )
        )
        for track in device.uses & set(self.stage.tracks):
            begin_us, end_us = EPOCH_US + self._begin_us, EPOCH_US + self._end_us
            signals.write(source[track], pieces(self.stage.tracks[track], begin_us, end_us))


def reconstruct(
    readings: NDArray[np.int64], period_us: float, harmonics: int = 3
) -> tuple[float, NDArray[np.float64]]:
    """One period of a wave from samples at many of its periods: the rms of what the harmonics leave
    over, by that of the wave (of a constant: NaN), and their amplitudes. Least squares (a Fourier
    series at the samples' own phases)."""
    angle = 2 * np.pi * readings[:, 0] / period_us
    columns = [np.ones_like(angle)]
    for k in range(1, harmonics + 1):
        columns += [np.sin(k * angle), np.cos(k * angle)]
    basis, values = np.stack(columns, axis=1), readings[:, 1].astype(float)
    found, *_ = np.linalg.lstsq(basis, values, rcond=None)
    wave = float(np.std(values))
    left = float(np.std(values - basis @ found)) / wave if wave > 0 else math.nan
    return left, np.hypot(found[1::2], found[2::2])
