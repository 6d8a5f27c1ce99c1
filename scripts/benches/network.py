"""The simulated networks: delay and loss of each profile, each way, and what a packet costs."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table

from headway.configs.schema import Channel
from headway.sim.bus import Bus
from headway.sim.network import Wire
from headway.sim.profiles import PROFILES

SIZE_BYTES = 120  # a status of arm2, about
EVERY_US = 4096  # as a loop sends; its phase in a frame wanders, as the bus has a clock of its own


def wire(channel: Channel, seed: int) -> Wire:
    """With a bus, if it needs one."""
    bus = Bus.of(channel.frame_us, np.random.default_rng(seed)) if channel.frame_us else None
    return Wire(channel, np.random.default_rng(seed + 1), bus)


def quantiles(name: str, way: str, packets: int) -> dict[str, Any]:
    """Delays [us] of what arrives, the first time, and the share of what does not, as a row."""
    channel: Channel = getattr(PROFILES[name], way)
    delays: list[int] = []
    arrived = 0
    for seed in range(4):  # a bus's rate and phase are drawn
        line = wire(channel, 2 * seed)
        for k in range(packets // 4):
            arrivals = line.carry(k * EVERY_US, SIZE_BYTES)
            if arrivals:
                delays.append(arrivals[0] - k * EVERY_US)
        arrived += line.sent - line.lost
    p50, p99, p999 = np.quantile(delays, (0.5, 0.99, 0.999))
    return {
        "profile": name,
        "way": way,
        "least us": float(channel.least_us),
        "p50 us": float(p50),
        "p99 us": float(p99),
        "p99.9 us": float(p999),
        "loss %": 100 * (1 - arrived / (packets // 4 * 4)),
    }


def cost_us(channel: Channel, packets: int) -> float:
    """Processor time of a packet, the best of three."""
    best = np.inf
    for _ in range(3):
        line, began = wire(channel, 1), time.process_time()
        for k in range(packets):
            line.carry(k * EVERY_US, SIZE_BYTES)
        best = min(best, (time.process_time() - began) / packets * 1e6)
    return best


def main() -> None:
    options = arguments(__doc__ or "")
    packets = 4_000_000 if options.long else 400_000
    rows = [quantiles(name, way, packets) for name in PROFILES for way in ("to_device", "to_host")]
    table("Delays and losses", rows)
    costs = {name: cost_us(profile.to_host, 100_000) for name, profile in PROFILES.items()}
    table("What a packet costs", [{"profile": n, "us": c} for n, c in costs.items()])
    finish(rows, [goal("us a packet at most", max(costs.values()), "<", 3)], options.json)


if __name__ == "__main__":
    main()
