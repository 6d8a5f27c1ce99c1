"""A second opinion on the vectors of a whole device: what docs/device.md promises.

By frames that are opened and decoded here, and by outputs. Nothing calls the firmware.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace

import pytest
from test_vectors import (
    EVENTS,
    EXITS,
    FLAGS,
    SIGNED,
    STATES,
    STATUS,
    VECTORS,
    Reader,
    Vector,
    is_whole,
    read,
    siphash,
    uncobs,
)

KEY = bytes(range(100, 116))  # in every record of settings
PERIOD_US, BRAKE_US, STOP_US, LATE_US = 1000, 3000, 20_000, 4000
HELLO_PAUSE_US = 20_000
COMMANDS = ["arm", "disarm", "resume", "stop", "clear", "home", "jog", "zero", "save", "faults"]
RESULTS = ["done", "not-now", "unhomed", "moving", "cause", "bad", "failed", "unsynced"]
COMMAND, STATUS_FRAME, LOG_FRAME, WELCOME = 4, 3, 5, 7
POWERED = {"armed", "running", "coast", "tail", "hold"}
# Where a command is carried out; what is not here is done in every state.
WHERE = {
    "arm": {"idle"},
    "disarm": {"armed", "hold"},
    "resume": {"hold"},
    "stop": POWERED - {"tail"},
    "clear": {"fault", "estop"},
    "home": {"armed"},
    "jog": {"armed"},
    "zero": {"unsynced", "idle"},
    "save": set(STATES) - POWERED,
}


def _steps() -> dict[str, set[str]]:
    """Where one event leads, by the page's table."""
    found: dict[str, set[str]] = {}
    for state in STATES:
        found[state] = {EXITS[state].get(event, state) for event in EVENTS}
        found[state] |= {"estop"} | ({"fault"} - ({state} if state == "estop" else set()))
    return found


STEPS = _steps()


def reachable(begin: str, cleared: bool) -> set[str]:
    """All that may be told next; a stop is left by CLEAR alone."""
    found, open_states = {begin}, [begin]
    while open_states:
        state = open_states.pop()
        for after in STEPS[state] - found:
            if state in ("fault", "estop") and after == "unsynced" and not cleared:
                continue
            if state == "estop" and after == "fault":
                continue
            found.add(after)
            open_states.append(after)
    return found


@dataclass(frozen=True)
class Keys:
    """Of a session: its host's, and its device's."""

    to_device: bytes
    to_host: bytes


@dataclass
class Scene:
    """A device as it is known from its lines so far."""

    status: dict[str, int] = field(default_factory=dict)  # the last one that was told
    sent: dict[int, int] = field(default_factory=dict)  # counters of its frames, by session
    power: int = 0
    brake_us: int = BRAKE_US  # since it was set; None would be a brake that is off
    braked: bool = True
    line_us: int = -1  # since the emergency line is open under power; -1: it is not
    line_open: bool = False
    cleared: bool = False  # CLEAR was given since the last status
    fresh: bool = False  # a status came with this line
    state: str = ""  # as the line with a status before this one told it
    lives: int = 0
    polled: bool = False  # in this life


def listed(answer: dict[str, str], name: str) -> list[int]:
    found: list[int] = []
    for part in answer[name].split(","):
        value, _, times = part.partition("*")
        found += [int(value)] * int(times or 1)
    return found


def of_status(payload: bytes) -> dict[str, int]:
    reader = Reader(payload)
    told = {"sent_us": reader.take(8, signed=True)}
    for name, size in STATUS:
        told[name] = reader.take(size, signed=name in SIGNED)
    told |= {flag: told["flags"] >> i & 1 for i, flag in enumerate(FLAGS)}
    for _ in range(told["sample_count"]):
        reader.varint(), reader.varint()
    reader.done()
    return told


class World:
    """Replays the file: `check` is called for each line, with the scene before and after."""

    def __init__(self) -> None:
        self.scene, self.kept = Scene(), dict[str, Scene]()
        self.sessions: dict[int, Keys] = {}
        self.seen: Counter[str] = Counter()
        self.hellos: list[bytes] = []

    def take(self, v: Vector) -> None:
        scene = self.scene
        if v.word == "device-keep":
            self.kept[v.given["slot"]] = deepcopy(scene)
        elif v.word == "device-recall":
            self.scene = deepcopy(self.kept[v.given["slot"]])
        elif v.word == "device-blank":
            self.scene = Scene()
        elif v.word == "device-boot":
            lives = scene.lives + 1
            self.scene = Scene(lives=lives, line_open=scene.line_open)
        elif v.word == "device-set":
            scene.line_open = bool(int(v.given.get("line_open", scene.line_open)))
        elif v.word == "device-give":
            self.given(v.bytes("packet"), int(v.given.get("port", "0")))
        elif v.word in ("device-run", "device-report", "device-hang"):
            self.ran(v)

    def given(self, packet: bytes, port: int) -> None:
        frame = uncobs(packet)
        if frame is None or port or len(frame) < 20:
            return
        if frame[1] == 6 and is_whole(frame):
            self.hellos.append(frame[2:18])
        if frame[1] == COMMAND and len(frame) == 31:
            self.scene.cleared |= frame[16] == COMMANDS.index("clear")

    def ran(self, v: Vector) -> None:
        pairs = [p.partition("=")[::2] for p in v.answer.split(" ")]
        answer = dict(pairs)
        self.outputs(v, answer)
        ports = [int(value) for name, value in pairs if name == "port"]
        packets = [bytes.fromhex(value) for name, value in pairs if name == "packet"]
        assert len(packets) == len(ports) <= int(answer["sent"]), v.line
        for port, packet in zip(ports, packets, strict=True):
            frame = uncobs(packet)
            assert frame is not None, v.line
            if port == 0:
                self.opened(v, frame)
        if v.word == "device-run":
            self.consistent(v, answer)

    def outputs(self, v: Vector, answer: dict[str, str]) -> None:
        """Off without power; the brake before the output goes off; both in time."""
        scene = self.scene
        power, brake = listed(answer, "power"), listed(answer, "brake")
        polls = int(v.given.get("polls", v.given.get("calls", "1")))
        step_us = int(v.given["step_us"])
        assert len(power) == len(brake) == polls, v.line
        if "duty_q15" in answer:
            for on, duty in zip(power, listed(answer, "duty_q15"), strict=True):
                assert on or duty == 0, v.line
                assert abs(duty) <= 32767, v.line
        assert power[-1] or answer.get("last_q15", "0") == "0", v.line
        for on, engaged in zip(power, brake, strict=True):
            if scene.polled and scene.power and not on:
                assert scene.braked and engaged, f"{v.line}: off before the brake"
                assert scene.brake_us + step_us >= BRAKE_US, f"{v.line}: before it has engaged"
                self.seen["off"] += 1
            assert on or engaged or not scene.lives, f"{v.line}: off without a brake"
            scene.brake_us = scene.brake_us + step_us if engaged and scene.braked else 0
            scene.power, scene.braked = on, bool(engaged)
            scene.polled |= v.word == "device-run"
            if scene.line_open and on:
                scene.line_us = max(0, scene.line_us) + step_us
                late_us = 2 * max(PERIOD_US, step_us)
                assert scene.line_us <= STOP_US + BRAKE_US + PERIOD_US + late_us, v.line
            else:
                scene.line_us = -1

    def opened(self, v: Vector, frame: bytes) -> None:
        """Every frame is authentic, and its counter is new."""
        scene = self.scene
        if frame[1] == WELCOME:
            assert is_whole(frame) and frame[0] == 1, v.line
            host, device = frame[2:18], frame[18:34]
            assert host in self.hellos, v.line
            derived = [siphash(KEY, bytes([n]) + host + device) for n in range(7)]
            assert frame[34:42] == derived[1].to_bytes(8, "little"), v.line
            keys = b"".join(word.to_bytes(8, "little") for word in derived)
            number = int.from_bytes(keys[16:20], "little")
            self.sessions[number] = Keys(keys[24:40], keys[40:56])
            assert int.from_bytes(device[:4], "little") == scene.lives, v.line
            self.seen["welcome"] += 1
            return
        number, counter = (int.from_bytes(frame[a:b], "little") for a, b in ((2, 6), (6, 12)))
        tag = siphash(self.sessions[number].to_host, b"\1" + frame[:-8])
        assert frame[0] == 1 and frame[-8:] == tag.to_bytes(8, "little"), v.line
        assert counter > scene.sent.get(number, 0), v.line
        scene.sent[number] = counter
        self.seen[f"frame {frame[1]}"] += 1
        if frame[1] == STATUS_FRAME:
            self.told(v, of_status(frame[12:-8]), number)
        if frame[1] == LOG_FRAME:
            for at in range(4, 244, 30):
                self.seen[f"reason {frame[12 + at]}"] += 1

    def told(self, v: Vector, status: dict[str, int], session: int) -> None:
        """States by the page's table; counters go up."""
        scene, state = self.scene, STATES[status["state"]]
        self.seen[state] += 1
        self.seen[f"reason {status['fault_reason']}"] += 1
        self.seen[f"refusal {status['refusal']}"] += 1
        if scene.status:
            before, same = scene.status, scene.status["session"] == session
            begin = STATES[before["state"]]
            assert state in reachable(begin, scene.cleared), f"{v.line}: {begin} to {state}"
            self.seen[f"{begin} to {state}"] += 1
            for name in ("plans_accepted", "plans_late", "plans_refused", "frames_bad", "coasts",
                         "stamps_excluded", "torque_clipped"):  # fmt: skip
                assert status[name] >= before[name], f"{v.line}: {name}"
            if same:
                assert status["command_number"] >= before["command_number"], v.line
                assert status["plan_seen"] >= before["plan_seen"], v.line
        assert status["plan_accepted"] <= status["plan_seen"], v.line
        assert status["command_result"] < len(RESULTS), v.line
        self.seen[f"result {RESULTS[status['command_result']]}"] += 1
        if state in POWERED:
            assert status["synced"] or state != "armed" or status["fault_reason"] == 0, v.line
        scene.status, scene.cleared, scene.fresh = {**status, "session": session}, False, True

    def consistent(self, v: Vector, answer: dict[str, str]) -> None:
        """Power as two statuses in a row have the state; what is between them is not told."""
        scene = self.scene
        if not scene.fresh:
            return
        power = listed(answer, "power")
        states = {STATES[scene.status["state"]], scene.state}
        if states <= POWERED:
            assert power[-1], f"{v.line}: {states} without power"
            self.seen["power"] += 1
        if states <= {"unsynced", "idle"}:
            assert not power[-1] or not scene.polled, f"{v.line}: {states} under power"
            self.seen["no power"] += 1
        scene.state, scene.fresh = STATES[scene.status["state"]], False


@pytest.fixture(scope="module")
def world() -> World:
    made = World()
    for v in read(VECTORS / "devices.txt"):
        made.take(v)
    return made


def lines() -> Iterator[Vector]:
    return read(VECTORS / "devices.txt")


def test_frames_outputs_and_states_are_what_the_page_promises(world: World) -> None:
    seen = world.seen
    assert {state for state in STATES if not seen[state]} == {"boot"}
    # An axis without homing is always homed: there is nothing that could make it forget.
    assert {name for name in RESULTS if not seen[f"result {name}"]} == {"unhomed"}
    assert seen["welcome"] > 20 and seen["off"] > 20


def test_every_reason_and_refusal_is_there(world: World) -> None:
    """But SETTINGS, with which a device is silent."""
    reasons = {n for n in range(20) if not world.seen[f"reason {n}"]}
    assert not reasons
    refusals = {n for n in range(1, 14) if not world.seen[f"refusal {n}"]}
    assert refusals <= {3, 4, 5, 6, 12}, refusals  # which gates.txt has


def _flipped(answer: str) -> str:
    head, _, tail = answer.rpartition(" hash=")
    return f"{head[:-1]}{'0' if head[-1] != '0' else '1'} hash={tail}"


PLANTED: dict[str, tuple[Callable[[str], bool], Callable[[str], str]]] = {
    "a duty without power": (
        lambda a: a.startswith("power=0*4 brake=1*4 duty_q15=0*4"),
        lambda a: a.replace("duty_q15=0*4", "duty_q15=0*3,5"),
    ),
    "off without a brake": (
        lambda a: a.startswith("power=1,0*3 brake=1*4"),
        lambda a: a.replace("brake=1*4", "brake=1,0,1*2"),
    ),
    "off before the brake has engaged": (
        lambda a: a.startswith("power=1*4 brake=0*4"),
        lambda a: a.replace("power=1*4 brake=0*4", "power=1*3,0 brake=0*3,1"),
    ),
    "a frame that is not authentic": (lambda a: " packet=" in a, _flipped),
    "power for ever": (
        lambda a: a.startswith("power="),
        lambda a: re.sub(r"\b0\b", "1", a, count=1),
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_what_is_planted_in_an_answer_is_noticed(name: str) -> None:
    fits, change = PLANTED[name]
    world, done = World(), False
    with pytest.raises(AssertionError):
        for v in lines():
            plants = fits(v.answer) and (name == "power for ever" or not done)
            world.take(replace(v, answer=change(v.answer)) if plants else v)
            done |= plants
