"""Vectors of a board's settings, and of what it remembers without power."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from random import Random

from line import Value, line

SINKS = ("position", "torque", "kp", "ki", "kd")
TOP, LOW = (1 << 31) - 1, -(1 << 31)
ONE: list[int] = [1, 0]
USUAL: dict[str, Value] = {
    "name": b"elbow", "key": bytes(range(16)), "peer_key": bytes(range(16, 32)),
    "knot_shift": 12, "servo_period_us": 256,
    "sample_every": 4, "brake_periods": 200, "stop_us": 500_000, "sync_lost_us": 2_000_000,
    "dither_us": 1234,
    "torque_step_tq": 300, "offset_count": -77, "carries_gravity": 0, "torque_limit_tq": 1 << 22,
    "integrate_running": 1, "following_pq": 5000, "following_periods": 3, "speed_pq": 40_000,
    "bounded": 1, "low_pq": -1_000_000, "high_pq": 2_000_000, "deceleration_q16": 65_536,
    "torque_periods": 70_000, "overload": 80_000, "heating_q16": 20_000, "rise_q16": 100_000,
    "stuck_pq": 9000, "stuck_periods": 90_000, "spike_counts": 300, "supply_min_mV": 18_000,
    "supply_max_mV": 30_000, "chopper_mV": 28_000, "late_us": 400, "home_method": 1,
    "home_backwards": 0, "home_mark_count": -5, "home_speed_q16": 70_000,
    "home_acceleration_q16": 500, "home_torque_tq": 1 << 20, "home_way_counts": 9000,
    "home_still_periods": 50, "sync_method": 1, "among_boards": 0, "drift_ppm": 250,
    "wander_ppb_s": 1500,
    "to_device_least_us": 2000, "to_host_least_us": 1999, "limit_us": 70_000,
    "interval_us": 80_000, "phase_gain": 4295, "skew_gain_q8": 11_000,
    "neighbours": 6, "ask_us": 20_000, "peer_least_us": 300, "step_least_q16": 0,
    "knot_periods": [16, 0], "kp_tq": [40_000, 9], "ki_tq": [1, 31],
    "kd_tq": [2, 3], "velocity_tq": [4, 5],
    "acceleration_tq": [3, 6], "ahead_us": 403, "resistance_mV": [6, 7], "emf_mV": [8, 9],
    "emf_tq": [10, 11], "supply_duty": [12, 13], "load_q8": [14, 15],
    "gap_policy": [0, 2, 2, 2, 2], "position": [0, -900, 900, 500, 60, 50],
    "torque": [0, -100, 100, 40, 30, 0], "kp": [0, 0, 9, 9, 9, 0],
}  # fmt: skip
SCALES = (
    *("knot_periods", "kp_tq", "ki_tq", "kd_tq", "velocity_tq"),
    *("acceleration_tq", "resistance_mV", "emf_mV"),
    *("emf_tq", "supply_duty", "load_q8"),
)
# Bytes of each number on the wire, in their order; negative: signed.
HEAD = (
    *(("knot_shift", 1), ("servo_period_us", 2), ("sample_every", 2), ("brake_periods", 2)),
    *(("stop_us", 4), ("sync_lost_us", 4), ("dither_us", 2), ("torque_step_tq", -4)),
    *(("knot_periods", 0), ("offset_count", -4), ("carries_gravity", 1)),
)
SERVO = (
    *((name, 0) for name in SCALES[1:10]),
    *(("torque_limit_tq", -4), ("integrate_running", 1), ("ahead_us", 2)),
)
MONITOR = (
    *(("following_pq", -4), ("following_periods", 2), ("speed_pq", -4), ("bounded", 1)),
    *(("low_pq", -4), ("high_pq", -4), ("deceleration_q16", -4), ("torque_periods", 4)),
    *(("load_q8", 0), ("overload", 4), ("heating_q16", 2), ("rise_q16", -4), ("stuck_pq", -4)),
    *(("stuck_periods", 4), ("spike_counts", -4), ("supply_min_mV", -4), ("supply_max_mV", -4)),
    *(("chopper_mV", -4), ("late_us", 4)),
)
HOME = (
    *(("home_method", 1), ("home_backwards", 1), ("home_mark_count", -4), ("home_speed_q16", -4)),
    *(("home_acceleration_q16", -4), ("home_torque_tq", -4), ("home_way_counts", -4)),
    ("home_still_periods", 2),
)
SYNC = (
    *(("sync_method", 1), ("among_boards", 1), ("drift_ppm", 2), ("wander_ppb_s", 2)),
    *(("to_device_least_us", 4), ("to_host_least_us", 4), ("limit_us", 4), ("interval_us", 4)),
    *(("phase_gain", 2), ("skew_gain_q8", 2)),
)
AMONG = (("neighbours", 1), ("ask_us", 4), ("peer_least_us", 4), ("step_least_q16", 4))
FLAGS = ("carries_gravity", "integrate_running", "bounded", "home_backwards", "among_boards")


def _numbers(values: dict[str, Value], rows: tuple[tuple[str, int], ...]) -> bytes:
    out = b""
    for name, size in rows:
        value = values[name]
        if isinstance(value, list):
            out += value[0].to_bytes(2, "little") + bytes([value[1]])
        else:
            assert isinstance(value, int)
            out += (value % (1 << 8 * abs(size))).to_bytes(abs(size), "little")
    return out


def encoded(values: dict[str, Value], with_key: bool) -> bytes:
    """The layout of format 4."""
    name, key, peer_key = values["name"], values["key"], values["peer_key"]
    policies = values["gap_policy"]
    assert isinstance(name, bytes) and isinstance(key, bytes) and isinstance(peer_key, bytes)
    assert isinstance(policies, list)
    out = (
        b"\4"
        + (key + peer_key if with_key else b"")
        + name.ljust(26, b"\0")
        + _numbers(values, HEAD)
    )
    out += bytes(policies)
    for sink in SINKS:
        limits = values.get(sink, [0] * 6)
        assert isinstance(limits, list)
        out += bytes([limits[0]]) + b"".join(
            (x % (1 << 32)).to_bytes(4, "little") for x in limits[1:]
        )
    return out + b"".join(_numbers(values, rows) for rows in (SERVO, MONITOR, HOME, SYNC, AMONG))


def settings(rng: Random) -> Iterator[str]:
    """Each bound of what is valid; encode and decode, each field by itself, every cut."""
    yield line("settings-usual", **USUAL)
    yield line("settings-valid")
    yield from _bounds()
    sizes = {name: size for row in (HEAD, SERVO, MONITOR, HOME, SYNC, AMONG) for name, size in row}
    for with_key in (0, 1):
        whole = encoded(USUAL, bool(with_key))
        yield line("settings-decode", with_key=with_key, bytes=whole)
        for capacity in (len(whole), len(whole) + 1, len(whole) - 1, len(whole) // 2, 1, 0):
            yield line("settings-encode", with_key=with_key, capacity=capacity)
        for cut in (0, 1, 40, len(whole) - 1):
            yield line("settings-decode", with_key=with_key, bytes=whole[:cut])
        yield line("settings-decode", with_key=with_key, bytes=whole + b"\0")
        for number in (0, 3, 5, 255):
            yield line("settings-decode", with_key=with_key, bytes=bytes([number]) + whole[1:])
    odd = dict(USUAL)
    odd |= {"name": bytes(range(65, 90)), "key": rng.randbytes(16), "gap_policy": [0, 255, 4, 1, 3]}
    odd["peer_key"] = rng.randbytes(16)
    for name, size in sizes.items():
        if size == 0:
            odd[name] = [rng.randrange(1 << 16), rng.randrange(1 << 8)]
        elif name not in FLAGS:
            odd[name] = rng.randrange(1 << 8 * abs(size)) - (1 << 31 if size < 0 else 0)
    for sink in SINKS:
        odd[sink] = [1, *(rng.randrange(LOW, TOP) for _ in range(5))]
    for flag in FLAGS:
        values = odd | dict.fromkeys(FLAGS, 0) | {flag: 1}
        yield line("settings-encode", with_key=1, capacity=480, **values)
        yield line("settings-decode", with_key=1, bytes=encoded(values, True))
        at = next(
            i
            for i, (a, b) in enumerate(
                zip(encoded(values, False), encoded(values | {flag: 0}, False), strict=True)
            )
            if a != b
        )
        for number in (2, 255):  # no flag has such a value
            broken = bytearray(encoded(USUAL, False))
            broken[at] = number
            yield line("settings-decode", with_key=0, bytes=bytes(broken))


def _steppers() -> Iterator[str]:
    """What a stepper's rate, periods and search may be, to the last digit."""

    def valid(**values: Value) -> str:
        return line("settings-valid", **values)

    us = 1 << 16
    for method in range(4):
        yield valid(home_method=method, step_least_q16=us)
    yield valid(step_least_q16=(1 << 32) - 1)
    for shift, least in ((12, 20 * us), (9, 3 * us), (15, 500 * us), (12, (1 << 32) - 1)):
        rate = (1 << 26) // 1024 * 1023 * (1 << shift) // least  # pq in a knot
        curve = (2 << 10) * (1 << 2 * shift) // 256**2
        for more in (-1, 0, 1):
            for numbers in (
                [0, -900, 900, rate + more, 60, 50],
                [0, -900, 900, 1, curve + more, 50],
            ):
                yield valid(
                    knot_shift=shift, ahead_us=0, step_least_q16=least, position=numbers,
                    home_speed_q16=1,
                )  # fmt: skip
    for period in (2047, 2048, 2049):
        yield valid(step_least_q16=us, servo_period_us=period, position=[0, -9, 9, 1, 1, 1])
    for least in (20 * us, 900 * us, 1 << 31):
        speed = (1 << 42) * 256 // least
        for more in (-1, 0, 1):
            if speed + more < 1 << 30:
                yield valid(
                    step_least_q16=least, home_speed_q16=speed + more, position=[0, -9, 9, 1, 1, 1]
                )


def _bounds() -> Iterator[str]:
    def valid(**values: Value) -> str:
        return line("settings-valid", **values)

    for name in SCALES:
        for shift in (0, 31, 32, 33, 255):
            yield valid(**{name: [1, shift]})
    for name, values in (
        ("knot_shift", (8, 9, 15, 16)),
        ("torque_limit_tq", ((1 << 25) - 1, 1 << 25, (1 << 25) + 1)),
        ("ahead_us", (0, 4095, 4096, 4097, 65_535)),
        ("spike_counts", ((1 << 18) - 1, 1 << 18, (1 << 18) + 1)),
        ("home_speed_q16", ((1 << 30) - 1, 1 << 30, (1 << 30) + 1)),
        ("home_method", (2, 3, 4, 5, 255)),
        ("sync_method", (0, 1, 2, 3, 255)),
        ("drift_ppm", (0, 1, 299, 300, 301, 65_535)),
        ("wander_ppb_s", (0, 1, 59_999, 60_000, 60_001, 65_535)),
        ("to_device_least_us", (0, 999_999, 1_000_000, 1_000_001, (1 << 32) - 1)),
        ("to_host_least_us", (0, 999_999, 1_000_000, 1_000_001, (1 << 32) - 1)),
        ("limit_us", (0, 1, 999_999, 1_000_000, 1_000_001, (1 << 32) - 1)),
        ("interval_us", (0, (1 << 32) - 1)),
        ("phase_gain", (0, 65_535)),
        ("skew_gain_q8", (0, 65_535)),
        ("dither_us", (0, 65_535)),
        ("among_boards", (0, 1)),
        ("neighbours", (0, 1, 2, 3, 4, 7, 8, 9, 14, 15, 16, 30, 32, 128, 255)),
        ("ask_us", (0, 1, 999, 1000, 9_999_999, 10_000_000, 10_000_001, (1 << 32) - 1)),
        ("peer_least_us", (0, 999_999, 1_000_000, 1_000_001, (1 << 32) - 1)),
    ):  # fmt: skip
        for value in values:
            yield valid(**{name: value})
    for shift in (0, 1, 8, 9, 15, 16):
        yield valid(knot_shift=shift, ahead_us=0)
    for ask_us in (0, 999, 10_000_000, 10_000_001):  # nobody is asked
        yield valid(neighbours=0, ask_us=ask_us)
    for name in (
        *("servo_period_us", "sample_every", "torque_step_tq", "torque_limit_tq", "following_pq"),
        *("speed_pq", "stuck_pq", "deceleration_q16", "spike_counts", "rise_q16"),
        *("home_speed_q16", "home_acceleration_q16", "home_torque_tq", "home_way_counts"),
    ):
        for value in (0, 1, 2) if name in ("servo_period_us", "sample_every") else (-1, 0, 1, 2):
            yield valid(**{name: value})
            if name.startswith("home_"):
                yield valid(home_method=0, **{name: value})
    yield from _steppers()
    for low, high in ((5, 4), (5, 5), (5, 6), (-5, -6)):
        yield valid(low_pq=low, high_pq=high)
    for size in (0, 1, 25, 26):
        yield valid(name=b"x" * size)
    yield valid(name=b"x" * 25 + b"\x80")  # the end of a longer one, whatever a char is
    for bounded in (0, 1):
        for continuous in (0, 1):
            yield valid(bounded=bounded, position=[continuous, -900, 900, 500, 60, 50])
            yield valid(bounded=bounded, torque=[continuous, -900, 900, 500, 60, 50])
    for sink in range(len(SINKS)):
        for difference, second in ((0, 0), (0, 1), (-1, 1), (1, 1), (1, 0), (1 << 25, 1)):
            for policy in range(6):
                policies = [0, 0, 0, 0, 0]
                policies[sink] = policy
                limits = [0, -1, 1, difference, second, 0]
                if policy in (0, 1, 2) or difference in (0, 1):
                    yield valid(gap_policy=policies, **{SINKS[sink]: limits})
    for carries in (0, 1):
        for policy in range(5):
            yield valid(carries_gravity=carries, gap_policy=[0, policy, 0, 0, 0])


BOOTS, FAULTS, SETTINGS = 2, 4, 0


def _crc(body: bytes) -> bytes:
    return zlib.crc32(body).to_bytes(4, "little")


def _record(generation: int, payload: bytes = b"") -> bytes:
    body = generation.to_bytes(4, "little") + payload
    return body + _crc(body)


def _cut_short() -> Iterator[str]:
    """Saves whose last byte is missing, over a record that ended with the same one: they failed."""
    for number in (700, 701, 702):
        end = _record(number)[-1]
        old = next(n for n in range(1, number - 1) if _record(n)[-1] == end)
        for first in (0, 1):
            yield line("store-record", record=BOOTS + first, bytes=_record(number - 1))
            yield line("store-record", record=BOOTS + 1 - first, bytes=_record(old))
            yield line("store-boot", kept=7)


def stores(rng: Random) -> Iterator[str]:
    """Boots, logs and settings, in turn and over damaged places; saves that end early."""
    yield line("settings-usual", **USUAL)
    yield line("store-blank")
    for _ in range(4):
        yield line("store-boot")
    torn, full = _record(7)[:-1], (1 << 32) - 1
    contents: list[bytes] = [
        *(b"", b"\0", torn, bytes(8), bytes(7), _record(6), _record(7), _record(0), _record(1)),
        *(_record(full), _record(full - 1), _record(full - 2), _record(7, b"payload")),
        *(_record(7)[:-1] + b"\0", b"\xff" * 512, _record(9, bytes(504)), _record(1 << 31)),
    ]
    for first in contents:
        for second in contents:
            small = min(len(first), len(second))
            if max(len(first), len(second)) > 99 and small not in (0, 1):
                continue
            yield line("store-record", record=BOOTS, bytes=first)
            yield line("store-record", record=BOOTS + 1, bytes=second)
            yield line("store-boot")
            if len(first) < 9 > len(second):
                yield line("store-boot")
    for kept in (0, 1, 4, 7, 8, 9):
        yield line("store-blank")
        yield line("store-boot", kept=kept)
        yield line("store-boot")
        yield line("store-boot", kept=kept)
        yield line("store-boot")
        yield line("store-boot", kept=kept)
        yield line("store-boot", kept=kept)
        yield line("store-boot")
    yield line("store-blank")
    for at in (0, 7, 3, 4, 5, 6, 0, 7, 0, 7):
        yield line("store-boot", flipped=at)
        yield line("store-boot")
    yield from _cut_short()
    for _ in range(2):
        yield line("store-boot", grown=1)
        yield line("store-boot")
    for body in (b"", b"\1", b"\1\0\0"):  # whole, but with no room for a generation
        yield line("store-blank")
        yield line("store-record", record=BOOTS, bytes=body + _crc(body))
        yield line("store-boot")
        yield line("store-record", record=SETTINGS, bytes=body + _crc(body))
        yield line("store-load-settings")
    yield line("store-load-faults")
    for count, kept in ((1, 512), (2, 512), (9, 512), (10, 200), (11, 512), (12, 251), (13, 252)):
        yield line("store-save-faults", count=count, kept=kept)
        yield line("store-load-faults")
    log = (3).to_bytes(4, "little") + bytes(240)
    for payload in (log, log[:-1], log + b"\0", b"", bytes(504)):
        yield line("store-record", record=FAULTS, bytes=_record(99, payload))
        yield line("store-load-faults")
    yield line("store-load-settings")
    for kept, name in ((512, b"a"), (512, b"b"), (100, b"c"), (512, b"d"), (0, b"e")):
        yield line("store-save-settings", kept=kept, name=name)
        yield line("store-load-settings")
    for payload in (encoded(USUAL, True), encoded(USUAL, False), encoded(USUAL, True)[:-1], b""):
        yield line("store-record", record=SETTINGS + 1, bytes=_record(100, payload))
        yield line("store-load-settings")
    yield line("store-record", record=SETTINGS, bytes=_record(101, bytes(rng.randbytes(30))))
    yield line("store-load-settings")
