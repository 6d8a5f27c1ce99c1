"""What devices get when nothing moves: stamps, commands, questions; and their answers."""

from __future__ import annotations

from collections.abc import Sequence

from headway.devices.link import Link
from headway.devices.remote import Remote


def attend(remotes: Sequence[Remote], link: Link, now_us: int) -> None:
    """Takes in what has arrived; asks for sessions, sends stamps and what else there is to say."""
    for device, received_us, packet in link.receive(now_us):
        remotes[device].receive(packet, received_us)
    for device, remote in enumerate(remotes):
        packets = remote.stamp_packets(now_us)
        if remote.established:
            packets += remote.questions()
        for packet in packets:
            link.send(device, packet, now_us)
