"""What a board remembers: settings as bytes, two places for each record, cuts and damage."""

import zlib
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headway.firmware import _core
from headway.sim import _board

KEY, PEER_KEY = bytes(range(100, 116)), bytes(range(150, 166))
SETTINGS, BOOTS = _board.RECORD_SETTINGS_A, _board.RECORD_BOOTS_A
FAULTS = _board.RECORD_FAULTS_A
STATE = {name: number for number, name in enumerate(_core.STATES)}

i32 = st.integers(-(1 << 31), (1 << 31) - 1)
unsigned = {bits: st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32)}
names = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])).filter(
    lambda name: len(name.encode()) <= _core.NAME_MAX
)
scales = st.builds(_core.Scale, unsigned[16], st.integers(0, 31))
point = st.integers(0, _core.POINT_MAX)
gate_limits = st.builds(
    _core.GateLimits,
    point.map(lambda p: -p),
    point,
    st.integers(1, _core.DIFFERENCE_MAX),
    st.integers(1, (1 << 31) - 1),
    st.integers(0, 2 * _core.DIFFERENCE_MAX),
    st.booleans(),
)
FIELDS: dict[str, dict[str, st.SearchStrategy[object]]] = {
    "": {
        "name": names,
        "brake_periods": unsigned[16],
        "stop_us": unsigned[32],
        "sync_lost_us": unsigned[32],
        "dither_us": unsigned[16],
        "neighbours": unsigned[8],
        "ask_us": unsigned[32],
        "peer_least_us": unsigned[32],
        "step_least_q16": unsigned[32],
        "torque_step_tq": i32,
        "knot_periods": scales,
        "offset_count": i32,
        "carries_gravity": st.booleans(),
        "knot_shift": unsigned[8],
        "servo_period_us": unsigned[16],
        "sample_every": unsigned[16],
    },
    "servo": {
        "kp_tq": scales,
        "ki_tq": scales,
        "kd_tq": scales,
        "velocity_tq": scales,
        "acceleration_tq": scales,
        "ahead_us": unsigned[16],
        "resistance_mV": scales,
        "emf_mV": scales,
        "emf_tq": scales,
        "supply_duty": scales,
        "torque_limit_tq": i32,
        "integrate_running": st.booleans(),
    },
    "monitor": {
        "following_pq": i32,
        "following_periods": unsigned[16],
        "speed_pq": i32,
        "bounded": st.booleans(),
        "low_pq": i32,
        "high_pq": i32,
        "deceleration_q16": i32,
        "torque_periods": unsigned[32],
        "load_q8": scales,
        "overload": unsigned[32],
        "heating_q16": unsigned[16],
        "rise_q16": i32,
        "stuck_pq": i32,
        "stuck_periods": unsigned[32],
        "spike_counts": i32,
        "supply_min_mV": i32,
        "supply_max_mV": i32,
        "chopper_mV": i32,
        "late_us": unsigned[32],
    },
    "home": {
        "method": unsigned[8],
        "backwards": st.booleans(),
        "mark_count": i32,
        "speed_q16": i32,
        "acceleration_q16": i32,
        "torque_tq": i32,
        "way_counts": i32,
        "still_periods": unsigned[16],
    },
    "sync": {
        "method": unsigned[8],
        "among_boards": st.booleans(),
        "drift_ppm": unsigned[16],
        "wander_ppb_s": unsigned[16],
        "to_device_least_us": unsigned[32],
        "to_host_least_us": unsigned[32],
        "limit_us": unsigned[32],
        "interval_us": unsigned[32],
        "phase_gain": unsigned[16],
        "skew_gain_q8": unsigned[16],
    },
}
OTHERWISE = {"key", "peer_key", "servo", "monitor", "home", "sync", "limits", "gap_policy"}
OTHERWISE |= {"valid", "encode", "decode"}  # checked by name below, or no field
OTHERWISE |= {"set_limits", "set_gap_policy"}
SINKS = range(5)


def part(made: _core.DeviceSettings, name: str) -> object:
    return getattr(made, name) if name else made


@st.composite
def device_settings(draw: st.DrawFn) -> _core.DeviceSettings:
    """Any numbers, whether they make sense or not."""
    made = _core.DeviceSettings()
    made.key, made.peer_key = (draw(st.binary(min_size=16, max_size=16)) for _ in range(2))
    for name, fields in FIELDS.items():
        for field, values in fields.items():
            setattr(part(made, name), field, draw(values))
    for sink in SINKS:
        made.set_limits(sink, draw(gate_limits))
        made.set_gap_policy(sink, draw(st.integers(0, len(_core.GAP_POLICIES) - 1)))
    return made


def plain(value: object) -> object:
    """Comparable."""
    if isinstance(value, _core.Scale):
        return value.mantissa, value.shift
    if isinstance(value, _core.GateLimits):
        return [getattr(value, name) for name in sorted(vars(_core.GateLimits)) if name[0] != "_"]
    return value


def every_field(made: _core.DeviceSettings) -> Iterator[tuple[str, object]]:
    for name, fields in FIELDS.items():
        for field in fields:
            yield f"{name}.{field}", plain(getattr(part(made, name), field))
    for sink in SINKS:
        yield f"limits {sink}", plain(made.limits(sink))
        yield f"gap_policy {sink}", made.gap_policy(sink)


def sound_settings(name: str = "shoulder", key: bytes = KEY) -> _core.DeviceSettings:
    """The least that is valid."""
    made = _core.DeviceSettings()
    made.name, made.key, made.peer_key = name, key, PEER_KEY
    made.knot_shift, made.servo_period_us, made.sample_every = 12, 1000, 1
    made.torque_step_tq, made.servo.torque_limit_tq = 1, 1 << 20
    for field in ("following_pq", "speed_pq", "stuck_pq", "deceleration_q16", "spike_counts"):
        setattr(made.monitor, field, 1)
    made.monitor.rise_q16 = made.home.acceleration_q16 = made.sync.limit_us = 1
    assert made.valid
    return made


def node_with(made: _core.DeviceSettings | None) -> _board.Node:
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    node.supply_V = 24.0
    if made:
        node.flash(made)
    return node


def record(generation: int, payload: bytes) -> bytes:
    body = generation.to_bytes(4, "little") + payload
    return body + zlib.crc32(body).to_bytes(4, "little")


def memory(node: _board.Node) -> list[bytes]:
    return [node.memory(record) for record in range(6)]


def remember(node: _board.Node, records: list[bytes]) -> None:
    for number, bytes_ in enumerate(records):
        node.set_memory(number, bytes_)


def torn(old: bytes, new: bytes) -> Iterator[bytes]:
    """What a cut at any byte may leave: over the old record, over an erased one, or a short one."""
    for at in range(len(new)):
        yield new[:at] + old[at:]
        yield new[:at] + bytes([0xFF]) * (len(new) - at)
        yield new[:at] + bytes(len(new) - at)
        yield new[:at]


# ---- settings as bytes


def test_every_field_is_known_here() -> None:
    """A new field has to be added to FIELDS, and so is tested."""
    owners = {
        "": _core.DeviceSettings,
        "servo": _core.ServoSettings,
        "monitor": _core.MonitorSettings,
        "home": _core.HomeSettings,
        "sync": _core.SyncSettings,
    }
    for name, owner in owners.items():
        public = {field for field in vars(owner) if field[0] != "_"}
        assert public - OTHERWISE == set(FIELDS[name]) - OTHERWISE, name


@given(device_settings(), st.booleans())
def test_settings_survive(made: _core.DeviceSettings, with_key: bool) -> None:
    back = _core.DeviceSettings.decode(made.encode(with_key), with_key)
    assert back is not None
    assert list(every_field(back)) == list(every_field(made))
    assert back.key == (made.key if with_key else bytes(16))
    assert back.peer_key == (made.peer_key if with_key else bytes(16))
    assert back.encode(with_key) == made.encode(with_key)


@given(device_settings(), st.data())
def test_one_field_changes_its_own_bytes_alone(
    made: _core.DeviceSettings, data: st.DataObject
) -> None:
    """So no two fields share bytes, and none is left out."""
    before = made.encode()
    name = data.draw(st.sampled_from(sorted(FIELDS)))
    field = data.draw(st.sampled_from(sorted(FIELDS[name])))
    old = plain(getattr(part(made, name), field))
    setattr(part(made, name), field, data.draw(FIELDS[name][field]))
    after = made.encode()
    differing = [i for i, pair in enumerate(zip(before, after, strict=True)) if len(set(pair)) > 1]
    assert bool(differing) == (plain(getattr(part(made, name), field)) != old)
    if differing:
        assert differing[-1] - differing[0] < (25 if field == "name" else 4)


def test_size_on_the_wire_and_in_memory() -> None:
    size = len(sound_settings().encode())
    assert len(sound_settings().encode(with_key=True)) == size + 32
    assert size <= 1000  # one frame
    assert size + 32 + 8 <= _board.RECORD_MAX


@pytest.mark.parametrize("key", [KEY, PEER_KEY])
def test_keys_are_not_in_what_goes_over_the_wire(key: bytes) -> None:
    assert key not in sound_settings().encode()
    assert key in sound_settings().encode(with_key=True)


@given(st.binary(max_size=600), st.booleans())
def test_other_bytes_are_no_settings(data: bytes, with_key: bool) -> None:
    back = _core.DeviceSettings.decode(data, with_key)
    assert back is None or back.encode(with_key) == data


def test_other_sizes_and_formats_are_no_settings() -> None:
    good = sound_settings().encode()
    for size in range(len(good)):
        assert _core.DeviceSettings.decode(good[:size]) is None
    assert _core.DeviceSettings.decode(good + b"\0") is None
    for version in range(256):
        back = _core.DeviceSettings.decode(bytes([version]) + good[1:])
        assert (back is not None) == (version == good[0] == 4)


def test_a_flag_is_zero_or_one() -> None:
    made = sound_settings()
    plain_bytes = made.encode()
    made.carries_gravity = True
    (at,) = [
        i for i, pair in enumerate(zip(plain_bytes, made.encode(), strict=True)) if pair == (0, 1)
    ]
    for value in range(256):
        damaged = plain_bytes[:at] + bytes([value]) + plain_bytes[at + 1 :]
        assert (_core.DeviceSettings.decode(damaged) is not None) == (value < 2)


@given(names)
def test_names(name: str) -> None:
    node = node_with(sound_settings(name))
    assert node.settings.name == name
    assert STATE["FAULT"] != node.state


@pytest.mark.parametrize("size", range(26))
def test_names_of_every_length(size: int) -> None:
    name = "ß" * (size // 2) + "x" * (size % 2)
    assert len(name.encode()) == size
    assert node_with(sound_settings(name)).settings.name == name


@pytest.mark.parametrize("name", ["x" * 26, "ß" * 13, "a\0b", "\0"])
def test_no_such_names(name: str) -> None:
    with pytest.raises(ValueError, match="up to 25 bytes"):
        _core.DeviceSettings().name = name


def test_a_scale_that_shifts_too_far_is_not_valid() -> None:
    """No such scale can be made here, but bytes can say one."""
    good = sound_settings()
    good.servo.kp_tq = _core.Scale(1, 31)
    encoded = good.encode()
    at = encoded.index(b"\x01\x00\x1f")
    worse = _core.DeviceSettings.decode(encoded[: at + 2] + b"\x20" + encoded[at + 3 :])
    assert good.valid
    assert worse is not None and not worse.valid


# ---- the records


def test_record_layout() -> None:
    node = node_with(sound_settings())
    assert node.memory(SETTINGS) == record(1, sound_settings().encode(with_key=True))
    assert node.memory(SETTINGS + 1) == b""
    assert node.memory(BOOTS) == record(1, b"")
    node.flash(sound_settings("elbow"))
    assert node.memory(SETTINGS) == record(1, sound_settings().encode(with_key=True))
    assert node.memory(SETTINGS + 1) == record(2, sound_settings("elbow").encode(with_key=True))
    assert node.settings.name == "elbow"
    node.flash(sound_settings("wrist"))
    assert node.memory(SETTINGS) == record(3, sound_settings("wrist").encode(with_key=True))


def test_an_empty_board_is_in_fault_and_silent() -> None:
    node = node_with(None)
    node.restart()
    for now in range(0, 100_000, 250):
        node.deliver(now, _core.hello(bytes(16)))
        node.poll(now, 0)
        assert node.collect() == []
        assert _core.STATES[node.state] == "FAULT"
        assert node.brake and not node.power and node.duty_q15 == 0
    assert _core.REASONS[node.status.fault.reason] == "SETTINGS"


def test_settings_that_are_whole_but_not_valid() -> None:
    made = sound_settings()
    made.servo_period_us = 0
    node = node_with(made)
    for now in range(0, 100_000, 250):
        node.deliver(now, _core.hello(bytes(16)))
        node.poll(now, 0)
        assert node.collect() == []
    assert _core.STATES[node.state] == "FAULT"
    assert node.brake and not node.power


@pytest.mark.parametrize("saves", [1, 2, 3])
def test_a_save_cut_short_leaves_the_older_settings(saves: int) -> None:
    node = node_with(sound_settings("zero"))
    for save in range(1, saves):
        node.flash(sound_settings(f"save {save}"))
    before, older = memory(node), node.settings.name
    node.flash(sound_settings("new"))
    after = memory(node)
    (changed,) = [r for r in (SETTINGS, SETTINGS + 1) if before[r] != after[r]]
    for left in torn(before[changed], after[changed]):
        remember(node, before)
        node.set_memory(changed, left)
        node.restart()
        assert node.settings.name == older
        node.flash(sound_settings("newer"))  # the next save does not touch the good one
        assert node.memory(SETTINGS + SETTINGS + 1 - changed) == before[1 - changed]
        assert node.settings.name == "newer"
        node.restart()
        assert node.settings.name == "newer"


def test_damage_to_both_places_is_a_fault() -> None:
    node = node_with(sound_settings("a"))
    node.flash(sound_settings("b"))
    good = memory(node)
    for bit in range(8 * len(good[SETTINGS])):
        for damaged in (1, 0):
            flipped = bytearray(good[SETTINGS + damaged])
            flipped[bit // 8] ^= 1 << bit % 8
            node.set_memory(SETTINGS + damaged, bytes(flipped))
            node.restart()
            if damaged == 1:
                assert node.settings.name == "a"
        assert _core.STATES[node.state] == "FAULT"
        remember(node, good)


def test_another_format_is_a_fault() -> None:
    node = node_with(sound_settings())
    payload = sound_settings().encode(with_key=True)
    for version, state in ((4, "BOOT"), (0, "FAULT"), (3, "FAULT"), (5, "FAULT"), (255, "FAULT")):
        node.set_memory(SETTINGS, record(5, bytes([version]) + payload[1:]))
        node.restart()
        assert _core.STATES[node.state] == state


def test_the_last_generation() -> None:
    """It does not wrap: what is there stays."""
    node = node_with(sound_settings())
    node.set_memory(SETTINGS, record((1 << 32) - 2, sound_settings("a").encode(with_key=True)))
    node.flash(sound_settings("b"))
    assert node.settings.name == "b"
    node.flash(sound_settings("c"))
    assert node.settings.name == "b"


# ---- boots


@given(st.lists(st.tuples(st.integers(0, 8), st.binary(max_size=12)), max_size=30))
def test_no_boot_number_comes_twice(cuts: list[tuple[int, bytes]]) -> None:
    """Whatever cuts leave behind in the place that was being written."""
    node = node_with(sound_settings())
    seen = [node.boots]
    for kept, rubbish in cuts:
        before = memory(node)
        node.restart()
        after = memory(node)
        (changed,) = [r for r in (BOOTS, BOOTS + 1) if before[r] != after[r]]
        if kept < 8:  # of 8 bytes; this boot was cut short, and nobody saw its number
            remember(node, before)
            node.set_memory(changed, after[changed][:kept] + rubbish)
        else:
            seen.append(node.boots)
    node.restart()
    seen.append(node.boots)
    assert seen == sorted(set(seen))


@given(st.lists(st.integers(0, 1), max_size=20), st.binary(min_size=1, max_size=8))
def test_no_boot_number_comes_again_after_damage_to_one_place(
    damages: list[int], rubbish: bytes
) -> None:
    node = node_with(sound_settings())
    node.restart()
    seen = [node.boots]
    for damaged in damages:
        node.set_memory(BOOTS + damaged, rubbish)
        for _ in range(2):  # both places are good again
            node.restart()
            seen.append(node.boots)
    assert seen == sorted(set(seen))


def test_a_lost_boot_counter_is_a_fault() -> None:
    """Its next number could be an old one: no session may begin."""
    node = node_with(sound_settings())
    node.restart()
    for place in range(2):
        node.set_memory(BOOTS + place, b"rubbish")
    node.restart()
    assert _core.STATES[node.state] == "FAULT"
    node.deliver(0, _core.hello(bytes(16)))
    node.poll(30_000, 0)
    assert node.collect() == []


def test_the_last_boot() -> None:
    node = node_with(sound_settings())
    node.set_memory(BOOTS, record((1 << 32) - 2, b""))
    node.restart()
    assert node.boots == (1 << 32) - 1
    assert _core.STATES[node.state] == "BOOT"
    for _ in range(2):
        node.restart()
        assert _core.STATES[node.state] == "FAULT"


# ---- faults


def fault_at(node: _board.Node, now_us: int) -> int:
    """The encoder jumps; returns the time when the log has been saved."""
    before = node.memory(FAULTS), node.memory(FAULTS + 1)
    node.poll(now_us, 0)
    while (node.memory(FAULTS), node.memory(FAULTS + 1)) == before:
        now_us += 250
        node.poll(now_us, 1 << 20)
        assert now_us < 10**8
    return now_us


def logged(node: _board.Node) -> list[_core.Fault]:
    """The newer log in memory, by its own generation."""
    whole = [r for r in (node.memory(FAULTS), node.memory(FAULTS + 1)) if r]
    newest = max(whole, key=lambda r: int.from_bytes(r[:4], "little"))
    faults = _core.faults_decode(newest[4:-4])
    assert faults is not None
    return faults


@settings(max_examples=20)
@given(st.integers(1, 12))
def test_faults_outlive_power_cycles(lives: int) -> None:
    node, now = node_with(sound_settings()), 0
    for _ in range(lives):
        now = fault_at(node, now + 250) + 250
        node.restart()
    assert [f.boots for f in logged(node)] == list(range(1, lives + 1))[-8:]
    assert {_core.REASONS[f.reason] for f in logged(node)} == {"SPIKE"}


def test_a_log_cut_short_leaves_the_older_one() -> None:
    node = node_with(sound_settings())
    now = fault_at(node, 250)
    node.restart()
    before = memory(node)
    now = fault_at(node, now + 250)
    after = memory(node)
    (changed,) = [r for r in (FAULTS, FAULTS + 1) if before[r] != after[r]]
    for left in list(torn(before[changed], after[changed]))[::7]:
        remember(node, before)
        node.set_memory(changed, left)
        node.restart()
        now = fault_at(node, now + 250)
        assert [f.boots for f in logged(node)] == [1, node.boots]
