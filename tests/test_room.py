"""Room to stop: what is planned keeps what the gate asks for, and nothing is refused over it."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.configs.load import load_config
from headway.controller.loop import Loop
from headway.controller.ocp import SPEED_SHARE, Limits
from headway.controller.record.recorder import Memory
from headway.devices import core
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parents[1]
ARM2 = ROOT / "configs" / "arm2.yaml"
# Both joints are led beyond both of their limits, at up to 2.5 and 6.3 rad/s.
BEYOND = [
    "task.frequency_Hz=0.25",
    "task.axes.0={offset_rad: 1.6, amplitude_rad: 1.6}",
    "task.axes.1={offset_rad: 1.0, amplitude_rad: 2.0, harmonic: 2}",
    "duration_s=5",
]


@given(st.floats(1, 500), st.floats(0.1, 30), st.floats(0, 1), st.floats(0, 1))
def test_the_barrier_implies_the_gates_condition(
    stop: float, fastest: float, share: float, depth: float
) -> None:
    """q + T v <= limit, at any planned speed, leaves room at four fifths of the deceleration."""
    config = load_config(
        ARM2,
        [
            f"machine.axes.0.stop_deceleration_rad_per_s2={stop}",
            f"machine.axes.0.velocity_limit_rad_per_s={fastest}",
        ],
    )
    time_s = float(Limits.of(config).approach_s[0])
    speed = share * SPEED_SHARE * fastest
    room = time_s * speed * (1 + depth)
    assert speed**2 <= 2 * 0.8 * stop * room * (1 + 1e-9)
    assert time_s >= 0.1


def test_a_reference_beyond_the_limits_is_followed_up_to_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refused: list[str] = []
    passing = Loop._passing

    def told(loop: Loop, tick, points, rolled, commit_knot):  # type: ignore[no-untyped-def]
        plan = passing(loop, tick, points, rolled, commit_knot)
        for remote, limits, tracks in zip(loop._remotes, loop._limits, points, strict=True):
            for sink, on_track in enumerate(tracks):
                at = commit_knot - 1
                refused.append(
                    core.gate_check_track(limits[sink], remote.track(sink), at, on_track, at)
                )
        return plan

    monkeypatch.setattr(Loop, "_passing", told)
    run = Lockstep(load_config(ARM2, BEYOND), ARM2.parent)
    run.run()
    assert set(refused) == {"accepted"}
    assert len(refused) >= 0.99 * run.ticks * 4  # two tracks on two axes
    assert isinstance(run.record, Memory)
    truth = run.record.arrays()["truth_position"]
    for i, axis in enumerate(run.config.machine.axes):
        assert truth[:, i].max() > axis.position_max - 0.15
        assert truth[:, i].max() < axis.position_max
