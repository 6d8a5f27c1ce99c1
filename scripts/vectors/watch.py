"""Vectors of the monitor: settings, then what servo periods saw, and the breach they are."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import Value, line

STUCK, SUPPLY, HEAT, WINDING, LOOKS = 1, 2, 4, 8, 15  # what need not be judged each period
SETTINGS: dict[str, Value] = {
    "following_pq": 5000, "following_periods": 3, "speed_pq": 40_000, "bounded": 1,
    "low_pq": -1_000_000, "high_pq": 2_000_000, "deceleration_q16": 65_536_000,
    "torque_periods": 4, "overload": 50, "heating_q16": 20_000, "rise_q16": 100_000,
    "stuck_pq": 9000, "stuck_periods": 5, "spike_counts": 300, "supply_min_mV": 18_000,
    "supply_max_mV": 30_000, "chopper_mV": 28_000, "late_us": 400, "load_q8": [1, 4],
}  # fmt: skip
QUIET: dict[str, Value] = {
    "count": 0, "position_pq": 0, "setpoint_pq": 0, "error_pq": 0, "torque_tq": 0,
    "torque_limit_tq": 10_000, "feedback_tq": 0, "clipped": 0, "supply_mV": 24_000, "late_us": 0,
    "power": 1, "driven": 1, "bounded": 1, "may_stand": 0,
    "looks": LOOKS, "heat_shift": 0, "stuck_periods": 1,
}  # fmt: skip
LOAD_ONE = 4096  # tq: 256 with load_q8 1/16


def _anew(**settings: Value) -> Iterator[str]:
    yield line("monitor", **settings)
    yield line("monitor-step")


def _step(**seen: Value) -> str:
    return line("monitor-step", **seen)


def _around(value: int) -> tuple[int, ...]:
    return value - 1, value, value + 1, -value + 1, -value, -value - 1


def _counts() -> Iterator[str]:
    """Jumps, the first period, the end of the number range, speed through its filter."""
    for jump in _around(300):
        yield from _anew(speed_pq=1 << 30, bounded=0)
        yield _step(count=jump)
        yield _step(count=jump)
        yield _step(count=jump + (5 if jump > 0 else -5))
    for first in (70_000, (1 << 31) - 1, -(1 << 31)):
        yield line("monitor", bounded=0)
        yield _step(count=first)
        turned = (first + 3 + (1 << 31)) % (1 << 32) - (1 << 31)
        yield _step(count=turned)
        yield _step(count=first)
    for step in (1, -1, 20, -20, 39, 40, -39, -40):
        yield from _anew(bounded=0)
        for times in (1, 2, 5, 20, 100):
            yield _step(count_step=step, times=times)
        yield line("monitor-begin")
        yield _step(count_step=step, times=3)
    for speed in (7999, 8000, 8001):  # through the filter: a jump of 63 counts is 8064 pq
        for sign in (1, -1):
            yield from _anew(bounded=0, speed_pq=speed)
            yield _step(count=sign * 62)
            yield from _anew(bounded=0, speed_pq=speed)
            yield _step(count=sign * 63)
    for limit in (8063, 8064, 8065):
        for sign in (1, -1):
            yield from _anew(bounded=0, speed_pq=limit)
            yield _step(count=sign * 63)
            yield from _anew(bounded=0, speed_pq=limit)
            yield _step(count=sign * 63, driven=0)


def _stuck() -> Iterator[str]:
    for way in _around(9000):
        yield from _anew()
        yield _step(setpoint_pq=way, times=2)
        yield from _anew()
        yield _step(setpoint_pq=way, count=1)
        yield _step(setpoint_pq=way, count=1, times=2)
        yield _step(setpoint_pq=0)
        yield from _anew()
        yield _step(setpoint_pq=way, driven=0)
        yield _step(driven=1)
        yield from _anew()
        yield line("monitor-begin")
        yield _step(setpoint_pq=way)
    for torque in _around(5000):
        yield from _anew()
        yield _step(torque_tq=torque, times=5)
        yield _step(torque_tq=torque, times=2)
        yield from _anew(stuck_pq=1 << 30)
        yield _step(torque_tq=torque, times=4)
        yield _step(torque_tq=torque, count=1)
        yield _step(times=5)
        yield _step(times=2)
        yield from _anew(stuck_pq=1 << 30)
        yield _step(torque_tq=torque, times=4)
        yield _step(torque_tq=torque, count=-1)
        yield _step(times=5)
        yield from _anew()
        yield _step(torque_tq=torque, times=4)
        yield _step(torque_tq=0)
        yield _step(torque_tq=torque, times=4)
        yield line("monitor-begin")
        yield _step(times=5)
        yield _step()
    for held in (4000, -4000, 5000, -9000):
        for push in (4999, 5000, -4999, -5000):  # from what held the load when it last moved
            yield line("monitor")
            yield _step(torque_tq=held)
            yield _step(torque_tq=held + push, times=6)
            yield _step(count=1, times=6)
    for seeks in ({"may_stand": 1}, {"may_stand": 1, "torque_tq": 6000}):
        for way in (9000, 9001, -9001):
            yield from _anew()
            yield _step(setpoint_pq=way, **seeks)
            yield _step(setpoint_pq=way, torque_tq=-9000, times=9)
            yield _step(setpoint_pq=2 * way, times=2)
            yield _step(may_stand=0, setpoint_pq=2 * way, times=5)
            yield _step(setpoint_pq=way, times=2)
            yield _step(setpoint_pq=way, torque_tq=0, times=6)
    yield from _anew()  # four periods pushed, then a search: they are forgotten
    yield _step(torque_tq=6000, times=4)
    yield _step(may_stand=1)
    yield _step(may_stand=0, torque_tq=12_000, times=5)
    yield _step()
    yield from _anew()
    yield _step(torque_tq=6000, times=4)
    yield _step(count=1, torque_tq=12_000)
    yield _step(torque_tq=6000, times=5)
    yield _step()
    yield from _anew()
    yield _step(torque_tq=5001, torque_limit_tq=10_003, times=9)
    yield from _anew()
    yield _step(torque_tq=-1, torque_limit_tq=2, times=9)
    yield from _anew()  # half of this ceiling is 0: any push is as hard
    for count in range(8):
        yield _step(count=count, torque_limit_tq=1)
    yield _step(times=4)
    yield _step()
    yield _step()
    yield from _anew()  # led on too far, and pushed: that period does not count as pushed
    yield _step(setpoint_pq=9001, torque_tq=6000)
    yield _step(setpoint_pq=0, times=5)
    yield _step()
    for top in ((1 << 31) - 1, -(1 << 31)):
        yield line("monitor")
        yield _step(setpoint_pq=top)
        yield _step(setpoint_pq=(top + 9001 + (1 << 31)) % (1 << 32) - (1 << 31))


def _supply() -> Iterator[str]:
    for supply in (17_999, 18_000, 18_001, 29_999, 30_000, 30_001, 0):
        yield from _anew()
        yield _step(supply_mV=supply, times=3)
        yield _step(supply_mV=supply, times=1)
        yield _step(supply_mV=supply, times=3)
        yield _step(supply_mV=24_000, times=1)
        yield _step(supply_mV=supply, times=3)
        yield _step(supply_mV=supply, times=2)
        yield _step(times=6)
        yield from _anew()
        yield _step(supply_mV=supply, power=0, times=6)
        yield _step(power=1, times=3)
        yield _step(times=1)
    yield from _anew()
    for supply in (27_999, 28_000, 28_001, 28_000, 27_563, 27_562, 27_563, 28_001, 27_000, 28_000):
        yield _step(supply_mV=supply)
    yield _step(supply_mV=28_001)
    yield _step(supply_mV=27_900, power=0)
    yield _step(supply_mV=27_000)
    for supply in (28_001, 27_564, 27_781, 27_563, 27_564, 28_001):
        yield _step(supply_mV=supply)
    yield from _anew()
    yield _step(supply_mV=17_000, times=3)
    yield _step(power=0)
    yield _step(power=1, times=3)
    yield _step()
    yield from _anew()
    yield _step(supply_mV=31_000, times=3)
    yield _step(power=0)
    yield _step(power=1, times=3)
    yield _step()


def _late() -> Iterator[str]:
    for late in (399, 400, 401, (1 << 31) - 1):
        for power in (0, 1):
            yield from _anew()
            yield _step(late_us=late, power=power)
            yield _step(late_us=0)


def _turns() -> Iterator[str]:
    """Periods in which it is another's turn."""
    for supply in (17_999, 30_001, 28_001):
        yield from _anew()
        for _ in range(4):
            yield _step(supply_mV=supply, looks=LOOKS - SUPPLY, times=3)
            yield _step(looks=SUPPLY)
        yield _step(supply_mV=24_000, looks=0, times=5)
        yield _step(looks=SUPPLY)
    for periods in (2, 8):  # stands still between two looks, and moves between two others
        yield from _anew(stuck_periods=5 * periods)
        yield _step(torque_tq=6000, looks=0, times=9)
        yield _step(torque_tq=0, looks=STUCK, stuck_periods=periods)
        for _ in range(7):
            yield _step(torque_tq=6000, looks=0)
            yield _step(looks=STUCK)
        yield _step(count=1, looks=LOOKS - STUCK)
        yield _step(looks=STUCK, times=7)
        yield _step(setpoint_pq=9001, looks=0, times=3)
        yield _step(looks=STUCK)
    for shift in (1, 4, 5):
        for torque in (LOAD_ONE - 16, LOAD_ONE + 16, -3 * LOAD_ONE, 1 << 20):
            yield from _anew(rise_q16=66_000, overload=400)
            yield _step(torque_tq=torque, looks=LOOKS - HEAT, times=7)
            yield _step(looks=HEAT, heat_shift=shift, times=300 >> shift)
            yield _step(looks=WINDING)
            yield _step(looks=LOOKS)
            yield _step(times=2)
            yield _step(power=0)
            yield _step(power=1, heat_shift=0, times=3)
    yield from _anew(rise_q16=100, heating_q16=65_535, overload=1 << 31)
    yield _step(torque_tq=LOAD_ONE, looks=LOOKS - WINDING, torque_limit_tq=1 << 30, times=400)
    yield _step(looks=WINDING)


def _heat() -> Iterator[str]:
    loads = (-16, 0, 16, LOAD_ONE, -3 * LOAD_ONE, 2 * LOAD_ONE)
    for torque in (LOAD_ONE + load for load in loads):
        yield from _anew(rise_q16=1 << 30)
        for times in (1, 10, 6, 1, 1, 30, 300):
            yield _step(torque_tq=torque, times=times)
        yield _step(torque_tq=0, times=3)
        yield _step(torque_tq=torque, times=3)
    yield from _anew(rise_q16=1 << 30, overload=0)
    yield _step(torque_tq=LOAD_ONE + 16, times=200)
    yield from _anew(rise_q16=1 << 30, overload=3)  # 511 * (257^2 - 256^2) is 4 * 65536 - 1
    yield _step(torque_tq=LOAD_ONE + 16, times=600)
    yield from _anew(rise_q16=0, heating_q16=65_535, overload=1 << 31)
    for _ in range(4):  # a mean below one
        yield _step(torque_tq=16, times=255)
        yield _step(torque_tq=0)
    yield from _anew(rise_q16=65_534, heating_q16=65_535, overload=1 << 31)
    yield _step(torque_tq=LOAD_ONE, times=2000)
    yield from _anew(rise_q16=40_000, heating_q16=32_768, overload=1 << 31)
    yield _step(torque_tq=LOAD_ONE, times=2000)
    for overload in (49, 50, 51):
        yield from _anew(rise_q16=1 << 30, overload=overload)
        yield _step(torque_tq=2 * LOAD_ONE, times=100)
    yield from _anew(rise_q16=1 << 30, overload=(1 << 32) - 1, load_q8=[65_535, 0])
    yield _step(torque_tq=(1 << 31) - 1, times=400)
    yield _step(torque_tq=-(1 << 25), times=400)
    for rise in (19_999, 20_000, 20_001, 100_000, 0):
        yield from _anew(rise_q16=rise, overload=(1 << 31) - 1)
        for times in (254, 1, 1, 255, 256, 2000):
            yield _step(torque_tq=LOAD_ONE, times=times)
        yield _step(torque_tq=0, times=600)
        yield _step(torque_tq=2 * LOAD_ONE, times=600)
    for shift, times in ((0, 256), (5, 8), (5, 9)):  # the greatest mean there is
        yield from _anew(rise_q16=1 << 27, overload=(1 << 32) - 1, load_q8=[65_535, 0])
        yield _step(torque_tq=1 << 25, looks=HEAT, heat_shift=shift, times=times)
        yield _step(looks=WINDING)
    for heating in (1, 100, 255):  # what one step adds is below one part in 65536
        yield from _anew(rise_q16=300, heating_q16=heating, overload=(1 << 31) - 1)
        for _ in range(3):
            yield _step(torque_tq=LOAD_ONE, times=256 * 40)
            yield _step(torque_tq=0, times=256 * 3)
    for heating in (0, 1, 65_535):
        yield from _anew(rise_q16=70_000, heating_q16=heating, overload=(1 << 31) - 1)
        for torque in (LOAD_ONE + 160, 3 * LOAD_ONE, 100):
            yield _step(torque_tq=torque, times=520)


def _room() -> Iterator[str]:
    """v^2 / 2 against a times the way to the limit ahead; beyond it, and with none ahead."""
    for sign in (1, -1):
        for room in (30, 31, 32, 33, 0, -1):  # 63 counts: v = 8064, v^2 / 2 / 1000 = 32514.05
            for way in (room, 32_513 - 31 + room):
                high = 2_000_000 if sign > 0 else -1_000_000
                yield from _anew()
                yield _step(count=sign * 63, position_pq=high - sign * way)
        for position in (32_513, 32_514, 32_515):
            yield from _anew(low_pq=-position, high_pq=position)
            yield _step(count=sign * 63)
            yield from _anew(low_pq=-position, high_pq=position)
            yield _step(count=sign * 63, bounded=0)
            yield _step(count=sign * 126, bounded=1)
            yield from _anew(low_pq=-position, high_pq=position, bounded=0)
            yield _step(count=sign * 63)
            yield from _anew(low_pq=-position, high_pq=position, deceleration_q16=65_536_001)
            yield _step(count=sign * 63)
    for sign in (1, -1):  # where rounded numbers are enough, and beyond: 8064^2 2^15 / a
        end = 2_000_000 if sign > 0 else -1_000_000
        yield from _anew(spike_counts=1000, speed_pq=1 << 30, deceleration_q16=1 << 20)
        yield _step(count=sign * 512, position_pq=end - sign * ((1 << 27) - 1))  # 65536^2 is 2^32
        for room, slow in (
            (53_271_855, 40_000), (16_253_930, 1 << 17), (2_031_742, 1 << 20), (126_984, 1 << 24),
        ):  # fmt: skip
            for aside in (-65_536, -1, 0, 1, 65_535, 131_072):
                yield from _anew(deceleration_q16=slow)
                yield _step(count=sign * 63, position_pq=end - sign * (room + aside))
    for position in (-1_000_001, -1_000_000, -999_999, 1_999_999, 2_000_000, 2_000_001):
        yield from _anew()
        yield _step(position_pq=position)
        yield _step(count=1)
        yield from _anew()
        yield _step(position_pq=position, count=-1)
    yield from _anew(spike_counts=262_143, speed_pq=(1 << 31) - 1, deceleration_q16=(1 << 31) - 1,
                     low_pq=-(1 << 31), high_pq=(1 << 31) - 1)  # fmt: skip
    for sign in (1, -1):
        end = (1 << 31) - 1 - 100_000_000
        yield _step(count_step=sign * 2930, times=60, position_pq=0)
        yield _step(count_step=sign * 2930, position_pq=sign * end)
        yield _step(count_step=sign * 2930, times=2, position_pq=0)
    for sign in (1, -1):
        yield _step(count_step=sign * 250_000, times=20, position_pq=-sign * (1 << 30))
    for times in range(26, 50, 3):  # down to the lowest speed
        for sign in (1, -1):
            yield from _anew()
            yield _step(count=sign)
            yield _step(times=times)
            yield _step(position_pq=2_000_001 if sign > 0 else -1_000_001)


def _rounded_room() -> Iterator[str]:
    """Where a room and a deceleration that are rounded down must not be taken for enough."""
    for sign in (1, -1):
        end = 2_000_000 if sign > 0 else -1_000_000
        for jump, room, slow in (
            (8, 1 << 30, 1),  # nothing is left of so small a deceleration
            (8, 0, 1 << 23),  # nor of this room
            (64, 1 << 16, 1 << 20),  # 8192^2 2^9 is 2^35
            (512, 1 << 22, 1 << 24),  # both beyond 16 bits, by the same bit
        ):
            yield from _anew(spike_counts=1000, speed_pq=1 << 30, deceleration_q16=slow)
            yield _step(count=sign * jump, position_pq=end - sign * room)
        for aside in (-1, 0, 1):  # 7056^2 / 2^9 is 97240.5, and 2431 * 40 is 97240
            yield from _anew(deceleration_q16=2431 << 8)
            yield _step(count=sign * 63, bounded=0)
            yield _step(bounded=1, position_pq=end - sign * ((40 << 16) + aside))
        yield from _anew(deceleration_q16=1)
        yield _step(count=sign, bounded=0, times=40)
        yield _step(bounded=1, position_pq=end - sign * 100)  # v is 1: 2^15 is above 100
        high = (1 << 31) - 1 if sign > 0 else -(1 << 31)
        for jump, room in (  # v is 3 and 6 million; what is above 2^22 is judged as 2^22
            (23_437, 137_000_000), (23_437, 138_000_000), (23_437, 186_000_000),
            (46_875, 1 << 20), (46_875, 1 << 27), (46_875, 1 << 28), (46_875, (1 << 28) + 1),
        ):  # fmt: skip
            yield from _anew(spike_counts=1 << 18, speed_pq=1 << 30, low_pq=-(1 << 31),
                             high_pq=(1 << 31) - 1, deceleration_q16=(1 << 31) - 1)  # fmt: skip
            yield _step(count=sign * jump, position_pq=high - sign * room)


def _inside() -> Iterator[str]:
    yield line("monitor")
    for position in (-1_000_001, -1_000_000, 0, 2_000_000, 2_000_001, -(1 << 31), (1 << 31) - 1):
        yield line("monitor-inside", position_pq=position)
    yield line("monitor", bounded=0)
    for position in (-1_000_001, -1_000_000, 2_000_000, 2_000_001):
        yield line("monitor-inside", position_pq=position)


def _motion() -> Iterator[str]:
    for error in _around(5000):
        yield from _anew()
        yield _step(error_pq=error, times=3)
        yield _step(error_pq=error, times=1)
        yield _step(error_pq=error, times=1)
        yield _step(error_pq=0)
        yield _step(error_pq=error, times=3)
        yield line("monitor-begin")
        yield _step(error_pq=error, times=3)
        yield _step(error_pq=error)
        for step in (2, 1, 0, -1, -2) if abs(error) == 5001 else ():
            for feedback in (-100, 0, 1, 100):
                yield from _anew(following_periods=8)
                yield _step(error_pq=error, feedback_tq=feedback, count_step=step, times=60)
    for step in (8, 9, 10, -8, -9, -10):  # filtered speed around one count a period
        for error in (6000, -6000):
            yield from _anew(following_periods=0)
            yield _step(error_pq=error, feedback_tq=error, count=step)
    yield from _anew(following_periods=0)  # a period too far behind does not count as clipped
    yield _step(error_pq=6000, clipped=1)
    yield _step(error_pq=0, times=4)
    yield _step()
    yield from _anew()
    yield _step(clipped=1, times=4)
    yield _step(clipped=1, times=1)
    yield _step(clipped=1, times=1)
    yield _step(clipped=0)
    yield _step(clipped=1, times=4)
    yield line("monitor-begin")
    yield _step(times=4)
    yield _step()
    yield _step(driven=0)


def _together(rng: Random) -> Iterator[str]:
    """Several at once: the order in which they are told."""
    bad: dict[str, dict[str, Value]] = {
        "spike": {"count": 5000},
        "stuck": {"setpoint_pq": 50_000},
        "late": {"late_us": 900},
        "under": {"supply_mV": 4000},
        "over": {"supply_mV": 40_000},
        "heat": {"torque_tq": 30_000_000},
        "outside": {"position_pq": -3_000_000},
        "room": {"position_pq": 1_999_990, "count_step": 20},
        "following": {"error_pq": 60_000},
        "torque": {"clipped": 1},
    }
    away: dict[str, Value] = {"error_pq": 60_000, "feedback_tq": 100, "count_step": -20}
    for name in ("under", "over", "heat"):  # the ninth period finds it reversed as well
        yield from _anew(following_periods=8, bounded=0, overload=0)
        yield _step(**away, times=5)
        yield _step(**away, **(bad[name] if name != "heat" else {}), times=3)
        yield _step(**away, **bad[name])
    names = list(bad)
    for i, name in enumerate(names):
        for other in names[i + 1 :]:
            yield from _anew(following_periods=3, torque_periods=3, stuck_periods=3)
            for _ in range(4):
                yield _step(**(bad[name] | bad[other]))
    for _ in range(70):
        chosen = rng.sample(names, 3)
        yield from _anew()
        for _ in range(4):
            seen = {k: v for name in chosen for k, v in bad[name].items() if rng.random() < 0.7}
            on = {name: int(rng.random() < 0.8) for name in ("power", "driven", "bounded")}
            on["may_stand"] = int(rng.random() < 0.2)
            yield _step(**seen, **on)


def _at_once() -> Iterator[str]:
    """Of several breaches in a period the one that is found first, unless a later one is looked for
    as well."""
    for sign, end in ((1, 2_000_001), (-1, -1_000_001)):
        yield from _anew(following_periods=0)  # outside, and driven outwards by its feedback
        behind = {"position_pq": end, "error_pq": -sign * 6000, "feedback_tq": -sign * 100}
        yield _step(count_step=sign * 20, times=20)
        yield _step(count_step=sign * 20, **behind)
        yield from _anew(speed_pq=8000)  # outside, and too fast
        yield _step(count=sign * 100, position_pq=end)


def monitors(rng: Random) -> Iterator[str]:
    """Each limit, a number at a time; then together."""
    yield line("monitor-usual", **SETTINGS)
    yield line("monitor-quiet", **QUIET)
    for family in (
        _counts,
        _stuck,
        _supply,
        _late,
        _heat,
        _turns,
        _room,
        _rounded_room,
        _inside,
        _motion,
        _at_once,
    ):
        yield f"# {family.__name__.strip('_')}"
        yield from family()
    yield "# together"
    yield from _together(rng)
