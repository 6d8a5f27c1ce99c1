"""Networks with a name: what the wires of a kind do to packets, each way.

docs/network.md has what comes of it, as measured, and the sources in full.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from headway.configs.schema import Channel, Sim


class Profile(NamedTuple):
    """Both directions."""

    to_device: Channel
    to_host: Channel


# A virtual serial port at full speed. Bulk transfers are retried until they arrive, in order (USB
# 2.0, section 5.8): nothing is lost.
FULL_SPEED: dict[str, Any] = {
    "loss": 0.0,
    "in_order": True,
    "frame_us": 1000,  # USB 2.0, section 7.1.12
    "bandwidth_bit_per_s": 9_728_000,  # at most 19 x 64 bytes a frame: USB 2.0, section 5.8.4
}
USB = Profile(
    to_device=Channel(
        **FULL_SPEED,
        slot_us=100,  # choice: the host's list of the frame begins with what goes out
        delay_us=60,  # choice: the last packet's check and the device's interrupt
        jitter_us=40,  # choice
    ),
    to_host=Channel(
        **FULL_SPEED,
        slot_us=350,  # choice: after what goes out and other devices' turns
        # Choice, within what Appelhoff and Stenner (2021) measured: below 1 ms in all with such
        # boards. The host's interrupt, its driver and the reader's wake-up.
        delay_us=150,
        jitter_us=90,
        # Choice: wake-ups of an ordinary kernel are late by 2 ms at worst (applied-ee.github.io),
        # which these exceed once in fifteen thousand.
        tail=0.01,
        tail_us=400,
    ),
)

# What is often taken for USB: as if each packet's wait had nothing to do with any other's.
USB_IID = Profile(
    to_device=Channel(delay_us=500, jitter_us=500, loss=0.0),
    to_host=Channel(delay_us=500, jitter_us=500, loss=0.0),
)

# A switch, a board without an operating system at one end and a host with one at the other.
SWITCHED: dict[str, Any] = {
    "bandwidth_bit_per_s": 100_000_000,  # 100BASE-TX (IEEE 802.3, clause 25)
    "loss": 1e-5,  # choice: a full queue somewhere
    "in_order": True,  # choice: one path, one queue
}
LAN = Profile(
    to_device=Channel(
        **SWITCHED,
        # Both ways together take 250 us over a 100 Mbit/s switch (E. Jones, ethernet-latency); the
        # parts and the spread are a choice.
        delay_us=110,
        jitter_us=30,
        tail=0.02,  # choice: another flow's frame is on the wire; the longest takes 123 us
        tail_us=60,
    ),
    to_host=Channel(
        **SWITCHED,
        delay_us=160,
        jitter_us=60,  # interrupts are held back by 0 to 125 us (ibid.)
        tail=0.01,  # choice: wake-ups, as above
        tail_us=400,
    ),
)

# A machine with an access point of its own, in a building with others.
RADIO: dict[str, Any] = {
    # At best 0.2 ms (doi 10.1515/ttj-2015-0030). Of round trips on a campus half take up to 3 ms,
    # one in ten 20 ms or more (Sui et al., MobiSys 2016); their 250 ms at one in a hundred are of
    # crowded channels, and what is here instead a choice.
    "delay_us": 1000,
    "jitter_us": 800,
    "loss": 0.01,  # choice
    "loss_run": 3.0,  # choice; that losses come in bursts: Carvalho et al., 2005
    "duplicate": 0.001,  # choice: an acknowledgement was lost
    "in_order": True,  # choice: a frame is repeated before the next one is sent
}
WIFI = Profile(
    to_device=Channel(**RADIO, tail=0.15, tail_us=5000),
    to_host=Channel(**RADIO, tail=0.15, tail_us=5000),
)

# Nothing that anyone should use: all numbers are a choice, to find out what breaks.
AWFUL = Profile(
    to_device=Channel(
        delay_us=2000,
        jitter_us=1500,
        tail=0.1,
        tail_us=8000,
        loss=0.05,
        loss_run=4.0,
        reorder=0.05,
        reorder_us=6000,
        duplicate=0.05,
    ),
    to_host=Channel(
        delay_us=8000,
        jitter_us=4000,
        tail=0.2,
        tail_us=18_000,
        loss=0.05,
        loss_run=4.0,
        reorder=0.1,
        reorder_us=15_000,
        duplicate=0.05,
    ),
)

PROFILES = {"usb": USB, "usb-iid": USB_IID, "lan": LAN, "wifi": WIFI, "awful": AWFUL}


def profile_of(sim: Sim) -> Profile:
    """The two directions of a simulation's network: as named, or as configured one by one."""
    if sim.network == "channels":
        return Profile(sim.to_device, sim.to_host)
    return PROFILES[sim.network]
