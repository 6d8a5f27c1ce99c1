"""A device at work, for the emulator: an axis of arm2 that follows plans on five tracks.

Each knot brings a plan of a whole horizon, each other poll is a servo tick,
with an encoder that follows the setpoint but for some counts of noise.
"""

from __future__ import annotations

import sys

import numpy as np
from emulator import Emulator, Tally
from tools import ROOT
from twin import Twin

from headway.configs.load import load_config
from headway.devices.axis import GAIN_BITS, GAIN_KNOTS
from headway.devices.settings import device_settings
from headway.firmware import _core
from headway.sim import _board

sys.path.insert(0, str(ROOT / "tests"))
import rig as bench

PERIOD_US, POLL_US = 100, 50  # the fastest there is, and a poll between two periods
POSITION, TORQUE, KP, KI, KD = range(5)
COUNT_OFFSET = 12_345
HORIZON = 55  # points of a plan that have not begun, as arm2's have
STOP_KNOTS = 24  # of these, from full speed to rest
NOISE_COUNTS = 3
WARM_UP_US = 1_000_000  # on the host alone
State = bench.State
FOLLOWING = State.RUNNING, State.COAST, State.HOLD
# The rig hands plans over at once, so nothing is known of the wire.
WIRE = ["sync.to_device_least_us=0", "sync.to_host_least_us=0", "sync.limit_us=2000"]


def settings(servo_period_us: int) -> _core.DeviceSettings:
    """A board of arm2's shoulder, with all that costs cycles: an integral, at work in a run."""
    changes = [*WIRE, f"device.servo_period_us={servo_period_us}"]
    config = load_config(ROOT / "configs" / "arm2.yaml", changes)
    made = device_settings(config.machine.axes[0], config.device, config.loop, config.sync)
    made.key = bench.KEY
    servo = made.servo
    servo.ki_tq, servo.integrate_running = _core.Scale(40_000, 26), True
    made.servo = servo
    top = servo.ki_tq.mantissa << GAIN_BITS
    made.set_limits(KI, _core.GateLimits(0, top, top // GAIN_KNOTS, top // GAIN_KNOTS))
    return made


class Scene:
    """The rig with its host; `polls` runs it, `twin` puts the emulator beside it."""

    def __init__(
        self,
        seed: int = 0,
        servo_period_us: int = PERIOD_US,
        poll_us: int = POLL_US,
        kinds: tuple[str, str] = ("compare", "window"),
    ) -> None:
        """`kinds`: of its two nodes."""
        self.settings = settings(servo_period_us)
        monitor = self.settings.monitor
        supply_V = (monitor.supply_min_mV + monitor.supply_max_mV) / 2000
        self.rig = bench.Rig(
            settings=self.settings,
            count_offset=COUNT_OFFSET,
            supply_V=supply_V,
            poll_us=poll_us,
        )
        self.rig.encoder = self._encoder
        self._rng = np.random.default_rng(seed)
        self._points: dict[int, list[int]] = {}
        self._knot = 0
        self.rig.sync().arm()
        self._rule(kinds)
        self._first()
        self.run(WARM_UP_US)

    def _encoder(self, true_us: int) -> int:
        rig = self.rig
        if rig.node.state not in FOLLOWING:
            return 0
        position_pq = rig.node.setpoint(rig.node.system_us(true_us))[0]
        noise = int(self._rng.integers(-NOISE_COUNTS, NOISE_COUNTS + 1))
        return (position_pq >> _core.COUNT_BITS) + noise

    def _step(self, sink: int, knot: int) -> float:
        """Of a track's points at a knot: a sine by a tenth of what the gate allows."""
        limits, turn = self.settings.limits(sink), 2 * np.pi / (60 + 7 * sink)
        range_step = (limits.point_max - limits.point_min) * turn / 2
        most = min(limits.difference_max, limits.second_difference_max / turn, range_step) / 10
        return float(most * np.cos(knot * turn))

    def _rule(self, kinds: tuple[str, str]) -> None:
        """Two nodes, of which an output follows the second, as the budget has it."""
        one, other = map(_core.NODE_KINDS.index, kinds)
        first = _core.SOURCE_OF_NODES
        nodes = [(one, POSITION, 0, 0, 1000), (other, TORQUE, 0, -1000, 1000)]
        payload = _core.logic_encode(1, nodes, [first, first + 1], [], [])
        self.rig.node.deliver(self.rig.now, self.rig.host.seal(_core.FRAME_LOGIC, payload))
        self.rig.poll()

    def _first(self) -> None:
        servo = self.settings.servo
        gains = {KP: servo.kp_tq, KI: servo.ki_tq, KD: servo.kd_tq}
        rest = {POSITION: 0, TORQUE: 0}
        rest |= {sink: gain.mantissa << (GAIN_BITS - 1) for sink, gain in gains.items()}
        first = self._knot = self.rig.knot + _core.LIVE_KNOTS
        self._points = {sink: [value] * HORIZON for sink, value in rest.items()}
        assert self.rig.give(first, self._points) == "accepted"

    def _plan(self) -> None:
        """The next one: a knot later, on along the sines, and to rest."""
        first = self.rig.knot + _core.LIVE_KNOTS
        tracks = {}
        for sink, before in self._points.items():
            done = before[: first - self._knot]
            value, points = float(done[-1] if done else before[0]), []
            for i in range(HORIZON):
                fade = min(1.0, max(0, HORIZON - 3 - i) / STOP_KNOTS)
                value += self._step(sink, first + i) * fade
                points.append(round(value))
            tracks[sink] = points
        result = self.rig.give(first, tracks)
        assert result == "accepted", (result, self.rig.reason)
        self._points, self._knot = tracks, first

    def run(self, us: int) -> None:
        """Polls, with a plan at the first poll of each knot."""
        for _ in range(us // self.rig.poll_us):
            knot = self.rig.knot
            self.rig.poll()
            if self.rig.knot != knot:
                self._plan()

    def emulate(self, core: Emulator) -> Twin:
        """From here on the emulator lives along."""
        rig = self.rig
        rig.syncing = False
        self.run(2 * rig.delay_us)  # nothing is under way
        rig.syncing = True
        counter = _board.Oscillator(COUNT_OFFSET)
        twin = Twin(rig.node, rig.memory, counter, core)
        rig.node = twin  # type: ignore[assignment]
        return twin


def is_tick(tally: Tally) -> bool:
    """Whether the servo ran in a poll, and nothing arrived."""
    return "servo_step" in tally.calls and tally.packets == 0
