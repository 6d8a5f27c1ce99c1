"""Gaps: knots that nobody sent points for, by each sink's policy; plans that cross the wrap."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from rig import (
    COUNT_PQ,
    KD,
    KI,
    KNOT_US,
    KP,
    PERIOD_US,
    POSITION,
    SHIFT,
    TORQUE,
    Plan,
    Points,
    Rig,
    State,
    device_settings,
)

from headway.firmware import _core

S = State
SINKS = (POSITION, TORQUE, KP, KI, KD)
POLICIES = _core.GAP_POLICIES
FILL_MAX = 4
REST: Plan = {POSITION: [0] * 12, TORQUE: [600] * 12, KP: [256] * 12, KI: [0] * 12, KD: [0] * 12}
LATER: Plan = {
    POSITION: [5000] * 12,
    TORQUE: [1600] * 12,
    KP: [512] * 12,
    KI: [512] * 12,
    KD: [256] * 12,
}


# DESIGN, section 3: a position is never held in a gap, a load never dropped. What is sensible for
# each sink, where no gravity acts.
SENSIBLE = {
    POSITION: {"interpolate", "ramp", "fault"},
    TORQUE: {"interpolate", "hold", "zero", "fault"},
    KP: {"interpolate", "hold", "fault"},
    KI: {"interpolate", "hold", "fault"},
    KD: {"interpolate", "hold", "fault"},
}


def settings_with(gravity: bool, **policies: str) -> _core.DeviceSettings:
    settings = device_settings()
    settings.carries_gravity = gravity
    for sink in (KP, KI, KD):
        settings.set_limits(sink, _core.GateLimits(0, 1 << 24, 1 << 24, 1 << 25))
    for name, policy in policies.items():
        sink = {"position": POSITION, "torque": TORQUE, "kp": KP, "ki": KI, "kd": KD}[name]
        settings.set_gap_policy(sink, POLICIES.index(policy))
    return settings


@pytest.mark.parametrize("gravity", [False, True])
@pytest.mark.parametrize(("sink", "policy"), [*itertools.product(SINKS, POLICIES)])
def test_sensible_policies(sink: int, policy: str, gravity: bool) -> None:
    valid = policy in SENSIBLE[sink] and not (gravity and policy == "zero")
    assert _core.gap_policy_valid(sink, POLICIES.index(policy), gravity) == valid
    settings = settings_with(gravity)
    settings.set_gap_policy(sink, POLICIES.index(policy))
    assert settings.valid == valid  # such a device stays in FAULT


@pytest.mark.parametrize("policy", POLICIES)
def test_a_sink_that_takes_no_track_has_no_policy(policy: str) -> None:
    settings = device_settings()  # no limits for KD
    settings.set_gap_policy(KD, POLICIES.index(policy))
    assert settings.valid


def test_policies_beyond_the_known() -> None:
    with pytest.raises(ValueError, match="no such"):
        device_settings().set_gap_policy(0, 5)
    assert not _core.gap_policy_valid(POSITION, 5, False)


def running(settings: _core.DeviceSettings, plan: Plan = REST) -> tuple[Rig, int]:
    """Running a plan that has just begun; its last knot."""
    rig = Rig(settings=settings)
    rig.sync().arm(600)
    first = rig.knot + 3
    assert rig.give(first, plan) == "accepted"
    return rig, first + len(plan[POSITION]) - 1


def curve(points: Points, first: int, times: range, shift: int) -> list[tuple[int, ...]]:
    track = _core.Track()
    track.write(first, np.array(points, dtype=np.int32))
    parts = track.evaluate(np.array(times), shift)
    return [tuple(int(v) for v in row) for row in zip(*parts, strict=True)]


@pytest.mark.parametrize("missing", range(1, 8))
@pytest.mark.parametrize("torque", ["interpolate", "hold", "zero"])
def test_missing_points_are_filled(missing: int, torque: str) -> None:
    """Up to four: on a straight line, again, or none. More are refused; the old plan runs on."""
    rig, end = running(settings_with(False, torque=torque))
    later = end + 1 + missing
    verdict = rig.give(later, LATER)
    if missing > FILL_MAX:
        assert verdict == "gap"
        assert rig.state == S.RUNNING
        assert rig.node.setpoint((end + 20) << SHIFT) == (0, 0, 600)
        return
    assert verdict == "accepted"
    share = [i / (missing + 1) for i in range(1, missing + 1)]
    filled = {
        "interpolate": [int(600 + 1000 * s) for s in share],
        "hold": [600] * missing,
        "zero": [0] * missing,
    }[torque]
    positions = [0] * 5 + [int(5000 * s) for s in share] + LATER[POSITION]
    torques = [600] * 5 + filled + LATER[TORQUE]
    times = range((end - 3) << SHIFT, (later + 5) << SHIFT, KNOT_US // 8)
    p, t = (curve(points, end - 4, times, SHIFT) for points in (positions, torques))
    for time, (position, rate, _), (effort, _, _) in zip(times, p, t, strict=True):
        assert rig.node.setpoint(time) == (position, rate, effort)


@pytest.mark.parametrize("missing", range(1, 8))
@pytest.mark.parametrize("sink", [KP, KI, KD])
@pytest.mark.parametrize("policy", ["interpolate", "hold"])
def test_gains_are_filled(missing: int, sink: int, policy: str) -> None:
    name = {KP: "kp", KI: "ki", KD: "kd"}[sink]
    settings = settings_with(True, **{name: policy})
    rig, end = running(settings, {POSITION: REST[POSITION], sink: REST[sink]})
    later = end + 1 + missing
    verdict = rig.give(later, {POSITION: [0] * 12, sink: LATER[sink]})
    assert verdict == ("accepted" if missing <= FILL_MAX else "gap")


@pytest.mark.parametrize("missing", [1, 4, 5, 100, 1 << 40])
@pytest.mark.parametrize(
    ("policies", "state", "reason"),
    [
        ({"position": "ramp"}, S.TAIL, "GAP"),
        ({"position": "fault"}, S.FAULT, "GAP_FAULT"),
        ({"torque": "fault"}, S.FAULT, "GAP_FAULT"),
        ({"position": "ramp", "kd": "fault"}, S.FAULT, "GAP_FAULT"),
    ],
)
def test_gaps_that_stop(missing: int, policies: dict[str, str], state: State, reason: str) -> None:
    rig, end = running(settings_with(True, **policies))
    assert rig.give(end + 1 + missing, LATER) == "gap"
    assert rig.state == state and rig.reason == reason
    fault = rig.node.status.fault
    assert (fault.value, fault.limit) == (min(missing, (1 << 31) - 1), FILL_MAX)
    assert fault.state == S.RUNNING
    rig.run(10 * PERIOD_US)
    assert rig.node.setpoint(0)[2] == 600  # the load is held all the way


def test_a_plan_that_follows_leaves_no_gap() -> None:
    rig, end = running(settings_with(True, position="fault", torque="fault"))
    assert rig.give(end + 1, LATER | {POSITION: [0] * 12}) == "accepted"
    assert rig.state == S.RUNNING


def test_a_filled_plan_is_judged_like_any_other() -> None:
    """The straight line is too steep, the live points would change, or there is no room left."""
    settings = settings_with(True)
    rig, end = running(settings)
    steep = 3 * (1 << 18)  # over three knots: the second difference is just not too large
    assert rig.give(end + 3, {**LATER, POSITION: [steep + 3] * 12}) == "acceleration"
    assert rig.give(end + 3, {**LATER, POSITION: [steep] * 12}) == "accepted"
    rig, end = running(settings)
    rig.run_to_knot(end - 1)  # what is missing is live by now
    assert rig.give(end + 3, LATER) == "late"
    rig, end = running(settings)
    full = {s: (LATER[s][:1] * 126) for s in LATER}
    assert rig.give(end + 4, full) == "gap"  # 126 and 3 are more than a plan holds
    full = {s: points[:125] for s, points in full.items()}
    assert rig.give(end + 4, full) in ("accepted", "far")


def test_a_track_that_was_left_out_has_a_gap_of_its_own() -> None:
    """The sink that misses most decides; the others keep what they have."""
    settings = settings_with(True, torque="hold")
    rig, end = running(settings)
    only = {s: LATER[s] for s in (POSITION, KP, KI, KD)}
    only[POSITION] = [0] * 14
    only = {s: (points * 2)[:14] for s, points in only.items()}
    assert rig.give(end - 11, {**only, KP: [256] * 14, KI: [0] * 14, KD: [0] * 14}) == "accepted"
    tracks = {POSITION: [0] * 12, TORQUE: [900] * 12, KP: [256] * 12, KI: [0] * 12, KD: [0] * 12}
    assert rig.give(end + 3, tracks) == "accepted"
    times = range((end - 3) << SHIFT, (end + 8) << SHIFT, KNOT_US // 8)
    expected = curve([600] * 7 + [900] * 12, end - 4, times, SHIFT)
    for time, (value, _, _) in zip(times, expected, strict=True):
        assert rig.node.setpoint(time)[0] == 0
        assert rig.node.setpoint(time)[2] == value


# ---- continuous axes


def turning(count: int) -> Rig:
    settings = device_settings()
    settings.set_limits(POSITION, _core.GateLimits(0, 0, 1 << 20, 1 << 18, 0, True))
    rig = Rig(settings=settings)
    rig.encoder = lambda now: count
    return rig.sync()


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_plan_across_the_wrap_moves_smoothly(sign: int) -> None:
    """The axis follows through 2^31: the error is what it is anywhere, and so is the torque."""
    turn = 1 << 21  # counts in 2^31 pq: the wrap
    rigs = []
    for base in (sign * (turn - 50), 1000 * sign):
        rig = turning(base)
        rig.arm()
        point = base * COUNT_PQ
        moves = [0] * 3 + [sign * (1 << 13) * i for i in range(40)] + [sign * (1 << 13) * 39] * 10
        points = [int(np.int64(point + m).astype(np.int32)) for m in moves]
        first = rig.knot + 8
        assert rig.give(first, {POSITION: points, TORQUE: [0] * len(points)}) == "accepted"
        begin, rate = rig.now, 8 * 1000 // 4096 + 0.96
        rig.encoder = lambda now, b=base, t=begin, r=rate: (
            b + sign * max(0, int((now - t - 45_000) * r / 1000))
        )
        rows = []
        for _ in range(220):
            rig.period()
            assert rig.state in (S.RUNNING, S.COAST)
            rows.append((rig.node.torque_tq, rig.node.setpoint(rig.node.system_us(rig.now))[1]))
        rigs.append(rows)
    assert rigs[0] == rigs[1]
    assert max(abs(torque) for torque, _ in rigs[0]) < 1 << 20


@given(st.integers(-(1 << 31), (1 << 31) - 1), st.integers(0, 2**32))
def test_gate_and_track_are_the_same_anywhere_on_a_turning_axis(offset: int, seed: int) -> None:
    """Shifted points get the same verdict and give the same shifted curve, modulo 2^32."""
    rng = np.random.default_rng(seed)
    steps = np.clip(np.cumsum(rng.integers(-60_000, 60_001, 20)), -(1 << 19), 1 << 19)
    steps[:3] = 0
    steps[-2:] = 0
    points = np.cumsum(steps)
    d, d2 = int(rng.integers(1 << 14, 1 << 19)), int(rng.integers(1 << 14, 1 << 18))
    limits = _core.GateLimits(0, 0, d, d2, 0, True)
    results = []
    for shift in (0, offset):
        moved = ((points + shift + (1 << 31)) % (1 << 32) - (1 << 31)).astype(np.int32)
        track = _core.Track()
        track.write(0, moved[:8])
        verdict = _core.gate_check_track(limits, track, 8, moved[8:], 4)
        track.write(8, moved[8:])
        value, rate, bend = track.evaluate(np.arange(2 << SHIFT, 20 << SHIFT, 97), SHIFT)
        results.append((verdict, (value.astype(np.int64) - shift) % (1 << 32), rate, bend))
    (a, *curves), (b, *others) = results
    assert a == b
    for one, other in zip(curves, others, strict=True):
        assert np.array_equal(one, other)


@given(st.integers(-(1 << 31), (1 << 31) - 1))
def test_a_first_plan_starts_where_a_turning_axis_is(count: int) -> None:
    """Near, modulo 2^32 pq, is near."""
    assume(abs(count) < 1 << 30)
    rig = turning(count)
    rig.arm()
    for off, verdict in ((64 * COUNT_PQ + 1, "start"), (64 * COUNT_PQ, "accepted")):
        point = (count * COUNT_PQ + off + (1 << 31)) % (1 << 32) - (1 << 31)
        assert rig.give(rig.knot + 4, {POSITION: [point] * 4}) == verdict
