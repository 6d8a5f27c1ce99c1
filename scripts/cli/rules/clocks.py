"""Rules of what the boards' clocks rely on: the wires' least delays, the oscillators' bounds.

An interval holds as long as these are true (docs/time.md). Of the simulated world it is known.
"""

from __future__ import annotations

from collections.abc import Iterator

from headway.cli.rules.rule import Rule, at_most
from headway.cli.rules.subject import Subject
from headway.configs.schema import Channel
from headway.firmware import _core
from headway.sim.profiles import profile_of


def clock_rules(subject: Subject) -> Iterator[Rule]:
    """All of them."""
    sync, sim = subject.config.sync, subject.config.sim
    wires = profile_of(sim)
    stamps = len(_core.sync_encode((0, 0, 0)))
    status = next(n for n in range(_core.PACKET_MAX) if _core.status_decode(bytes(n)) is not None)
    yield _least("to_device", sync.to_device_least_us, wires.to_device, stamps)
    yield _least("to_host", sync.to_host_least_us, wires.to_host, status)
    for key, true, unit in (
        ("drift_ppm", sim.clocks.drift_ppm, "ppm"),
        ("wander_ppm_per_s", sim.clocks.wander_ppm_per_s, "ppm/s"),
    ):
        yield at_most(
            f"clocks: {key} of the simulated boards",
            true,
            getattr(sync, key),
            unit,
            f"sim.clocks.{key} goes beyond what sync.{key} promises: the interval is false",
        )


def _least(way: str, told_us: int, channel: Channel, payload_bytes: int) -> Rule:
    """A frame that is faster than the least delay proves what is not so."""
    sealed = _core.Session(bytes(16), bytes(16), 0).seal(_core.FRAME_SYNC, bytes(payload_bytes))
    bits = 8_000_000 * len(sealed)  # of the shortest frame with stamps
    bandwidth = channel.bandwidth_bit_per_s
    least_us = channel.least_us + (bits // bandwidth if bandwidth else 0)
    key = f"sync.{way}_least_us"
    return at_most(
        f"clocks: least delay {way}",
        told_us,
        least_us,
        "us",
        f"{key} says that no frame takes less than {told_us} us, but of the simulated wires some "
        f"take {least_us}: the clocks' interval is false, or they do not settle; set {key} to "
        f"{least_us} or less",
    )
