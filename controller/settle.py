"""Whether the devices' clocks have settled: the service that start-up and `headway sync` share."""

from __future__ import annotations

from collections.abc import Sequence

from headway.devices.clock import ClockState
from headway.devices.remote import Remote

# Why there is no session yet, by what came of HELLO (Remote.greeting).
NO_SESSION = {
    "no answer": "no answer: is the board connected, powered and set up?",
    "ok": "no answer in the session: does another host run it?",
    "wrong key": "wrong key: the board was set up with another one",
    "line noise": "line noise: what it answers arrives damaged",
    "other version": "its firmware speaks another version of the protocol",
    "stale": "it answers what was asked long ago: restart it",
}


class Settle:
    """Watches the clocks of all devices of a machine."""

    def __init__(self, joints: Sequence[str], remotes: Sequence[Remote]) -> None:
        self._joints, self._remotes = joints, remotes
        self._since_us: int | None = None  # when all were found settled

    def tick(self, now_us: int) -> list[ClockState]:
        """How each clock is, at a time of the host's. To be called in the order of time."""
        states = [remote.clock.state(now_us) for remote in self._remotes]
        if not all(state.settled for state in states):
            self._since_us = None
        elif self._since_us is None:
            self._since_us = now_us
        return states

    def settled_us(self, now_us: int) -> int:
        """How long all have stayed settled; -1 if they are not."""
        return -1 if self._since_us is None else now_us - self._since_us

    def unsettled(self, now_us: int) -> list[str]:
        """Who is not, and why."""
        found = []
        for joint, remote in zip(self._joints, self._remotes, strict=True):
            state = remote.clock.state(now_us)
            if not state.settled:
                why = _why(state) if remote.established else NO_SESSION[remote.greeting]
                found.append(f"{joint}: {why}")
        return found


def _why(state: ClockState) -> str:
    if (state.least_us is None or state.most_us is None) and state.excluded:
        return (
            f"its clock has no bound, as {state.excluded} stamps contradict others: are frames "
            "faster than sync.to_device_least_us and sync.to_host_least_us say, or has the host's "
            "clock jumped?"
        )
    if state.least_us is None or state.most_us is None:
        return "its clock has no bound yet: do frames pass in both directions?"
    if state.measured_us is None:
        return "nothing has come from it for a second: has its port gone?"
    if state.measured_us is not None and (
        state.least_us > state.measured_us[1] or state.most_us < state.measured_us[0]
    ):
        return (
            f"it says that its clock errs by {state.least_us:.0f} to {state.most_us:.0f} us, but "
            f"the stamps say {state.measured_us[0]:.0f} to {state.measured_us[1]:.0f}"
        )
    worst = max(-state.least_us, state.most_us)
    return (
        f"its clock may err by {worst:.0f} us: see sync.limit_us, or tell the least delays "
        "(sync.to_device_least_us, sync.to_host_least_us)"
    )
