"""The published vectors: the firmware agrees, and so does a second opinion written from the layout.

Nothing here calls the firmware but through the judge. The oracles are pure Python: hashes and
codecs byte by byte, splines by de Boor's algorithm in fractions, the gate from its definition.
"""

import math
import subprocess
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import pytest
from scripted import load_script

ROOT = Path(__file__).resolve().parents[1]
VECTORS = ROOT / "tests" / "vectors"
FILES = sorted(VECTORS.glob("*.txt"))
INT32_MAX = (1 << 31) - 1
TIME_MAX = 1 << 60
SINKS = ("position", "torque", "kp", "ki", "kd")


@dataclass(frozen=True)
class Vector:
    """One line: what is given, by name, and the answer."""

    line: int
    word: str
    given: dict[str, str]
    answer: str

    def number(self, name: str) -> int:
        return int(self.given[name])

    def bytes(self, name: str) -> bytes:
        return bytes.fromhex(self.given[name])

    def numbers(self, name: str) -> list[int]:
        """7,-5*3 is 7, -5, -5, -5."""
        found: list[int] = []
        for part in self.given.get(name, "").split(",") if self.given.get(name) else []:
            value, _, times = part.partition("*")
            found += [int(value)] * int(times or 1)
        return found


def read(path: Path) -> Iterator[Vector]:
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if line and not line.startswith("#"):
            asked, _, answer = line.partition(" -> ")
            word, *parts = asked.split(" ")
            yield Vector(number, word, dict(p.split("=", 1) for p in parts), answer)


# ---- the judge


@pytest.fixture(scope="session")
def judge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program: Path = load_script("vectors/judge").compile_judge(
        tmp_path_factory.mktemp("judge") / "judge"
    )
    return program


def test_the_firmware_agrees(judge: Path) -> None:
    done = subprocess.run([judge, *FILES], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_nothing_in_them_is_undefined(tmp_path: Path) -> None:
    module = load_script("vectors/judge")
    options = [*module.SANITIZE, "-DJUDGE_CPU_S=60"]
    program = module.compile_judge(tmp_path / "judge", options)
    done = subprocess.run(
        [program, *FILES], capture_output=True, text=True, env={"ASAN_OPTIONS": "detect_leaks=0"}
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_files_are_what_the_generator_writes(judge: Path) -> None:
    module = load_script("vectors/__main__")
    assert {path.stem for path in FILES} == {*module.KINDS, *module.DIALOGUES}
    for path in FILES:
        assert module.answered(judge, path.stem) == path.read_text(), path.stem


def test_they_stay_small() -> None:
    assert sum(path.stat().st_size for path in FILES) < 6_400_000


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_the_judge_notices_any_answer_changed(judge: Path, path: Path, tmp_path: Path) -> None:
    """One digit of the last answer: found, at its line, and nothing before it."""
    lines = path.read_text().splitlines()
    at = max(i for i, line in enumerate(lines) if " -> " in line)
    asked, _, answer = lines[at].partition(" -> ")
    lines[at] = f"{asked} -> {answer[:-1]}{'0' if answer[-1] != '0' else '1'}"
    wrong = tmp_path / "wrong.txt"
    wrong.write_text("\n".join(lines) + "\n")
    done = subprocess.run([judge, wrong], capture_output=True, text=True)
    assert done.returncode == 1
    assert f"wrong.txt:{at + 1}: {asked}" in done.stdout
    assert f"firmware:  {answer}\n" in done.stdout


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("siphash key=00 message= -> hash=0\n", "missing: prefix"),
        ("cobs-encode packet=0 -> bytes=01\n", "half a byte too many: packet"),
        ("cobs-encode packet=zz -> bytes=01\n", "not hexadecimal: packet"),
        ("cobs-encode packet= other=1 -> bytes=01\n", "unknown name: other"),
        ("track-point sink=kd knot=x -> point=0\n", "not a number: knot"),
        ("nonsense -> 1\n", "no such word: nonsense"),
        ("blank word\n", "not name=value, or too many: word"),
        ("blank", "not a whole line"),
    ],
)
def test_the_judge_gives_up_on_what_it_cannot_read(
    judge: Path, tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    done = subprocess.run([judge, path], capture_output=True, text=True)
    assert done.returncode == 2
    assert f"bad.txt:1: {message}" in done.stderr


# ---- bytes: written from Cheshire and Baker 1999, Aumasson and Bernstein 2012, and the headers


def cobs(packet: bytes) -> bytes:
    """A block of 254 bytes is followed by no zero; at the very end it needs no empty one behind."""
    out, groups = b"", packet.split(b"\0")
    for i, group in enumerate(groups):
        blocks = [group[at : at + 254] for at in range(0, len(group), 254)]
        if not blocks or (len(blocks[-1]) == 254 and i < len(groups) - 1):
            blocks.append(b"")
        out += b"".join(bytes([len(block) + 1]) + block for block in blocks)
    return out


def uncobs(data: bytes) -> bytes | None:
    if not data or 0 in data:
        return None
    out, at = b"", 0
    while at < len(data):
        length = data[at]
        if at + length > len(data):
            return None
        out += data[at + 1 : at + length]
        at += length
        if length < 255 and at < len(data):
            out += b"\0"
    return out


def siphash(key: bytes, message: bytes) -> int:
    mask = (1 << 64) - 1

    def left(x: int, n: int) -> int:
        return (x << n | x >> (64 - n)) & mask

    k0, k1 = (int.from_bytes(key[i : i + 8], "little") for i in (0, 8))
    name = b"somepseudorandomlygeneratedbytes"
    v = [int.from_bytes(name[i : i + 8], "big") ^ (k0, k1)[i // 8 % 2] for i in (0, 8, 16, 24)]

    def rounds(count: int) -> None:
        for _ in range(count):
            v[0] = (v[0] + v[1]) & mask
            v[2] = (v[2] + v[3]) & mask
            v[1] = left(v[1], 13) ^ v[0]
            v[3] = left(v[3], 16) ^ v[2]
            v[0] = left(v[0], 32)
            v[2] = (v[2] + v[1]) & mask
            v[0] = (v[0] + v[3]) & mask
            v[1] = left(v[1], 17) ^ v[2]
            v[3] = left(v[3], 21) ^ v[0]
            v[2] = left(v[2], 32)

    padded = message + bytes(7 - len(message) % 8) + bytes([len(message) % 256])
    for i in range(0, len(padded), 8):
        word = int.from_bytes(padded[i : i + 8], "little")
        v[3] ^= word
        rounds(2)
        v[0] ^= word
    v[2] ^= 0xFF
    rounds(4)
    return v[0] ^ v[1] ^ v[2] ^ v[3]


def judge_cobs_encode(v: Vector) -> str:
    return f"bytes={cobs(v.bytes('packet')).hex()}"


def judge_cobs_decode(v: Vector) -> str:
    packet = uncobs(v.bytes("bytes"))
    return "malformed" if packet is None else f"packet={packet.hex()}"


def judge_siphash(v: Vector) -> str:
    prefix = bytes([v.number("prefix")])
    return f"hash={siphash(v.bytes('key'), prefix + v.bytes('message')):016x}"


@dataclass
class End:
    """One end of a session. `taken`: counters that were accepted, or are said to have been."""

    at: str = ""
    number: int = 0
    begun: bool = False
    keys: dict[str, bytes] = field(default_factory=dict)
    sent: int = 0
    received: int = 0
    taken: set[int] = field(default_factory=set)

    def begin(self, v: Vector) -> None:
        self.at, self.number, self.begun = v.given["at"], v.number("number"), True
        self.keys = {name: v.bytes(f"{name}_key") for name in ("send", "receive")}
        self.sent = self.received = 0
        self.taken = {-i for i in range(64)}  # the first frame is number 1

    def set_counters(self, v: Vector) -> None:
        self.sent, self.received = v.number("sent"), v.number("received")
        window = int(v.given["window"], 16)
        self.taken = {self.received - i for i in range(64) if window >> i & 1}

    def tag(self, way: str, frame: bytes) -> bytes:
        """A byte for the direction comes first: 0 towards the device, 1 towards the host."""
        to_host = (self.at == "device") == (way == "send")
        return siphash(self.keys[way], bytes([to_host]) + frame).to_bytes(8, "little")

    def counters(self) -> str:
        window = sum((self.received - i in self.taken) << i for i in range(64))
        return f"sent={self.sent} received={self.received} window={window:016x}"

    def seal(self, v: Vector) -> str:
        if not self.begun or self.sent == (1 << 48) - 1:
            return f"refused {self.counters()}"
        self.sent += 1
        head = bytes([1, v.number("type")]) + self.number.to_bytes(4, "little")
        frame = head + self.sent.to_bytes(6, "little") + v.bytes("payload")
        return f"frame={(frame + self.tag('send', frame)).hex()} {self.counters()}"

    def verdict(self, frame: bytes) -> str:
        body, tag = frame[:-8], frame[-8:]
        if not 20 <= len(frame) <= 1020:
            return "bad-length"
        if frame[0] != 1:
            return "bad-version"
        if int.from_bytes(body[2:6], "little") != self.number or not self.begun:
            return "bad-session"
        counter = int.from_bytes(body[6:12], "little")
        if counter in self.taken or counter <= self.received - 64:
            return "replayed"
        if tag != self.tag("receive", body):
            return "bad-tag"
        self.taken.add(counter)
        self.received = max(self.received, counter)
        return f"ok counter={counter}"

    def open(self, v: Vector) -> str:
        verdict = self.verdict(v.bytes("frame"))
        return f"{verdict} {self.counters()}"


def test_frames_are_what_the_layout_says() -> None:
    end, seen = End(), Counter[str]()
    for v in read(VECTORS / "frames.txt"):
        expected = ""
        if v.word == "session-none":
            end = End()
        elif v.word == "session":
            end.begin(v)
        elif v.word == "session-counters":
            end.set_counters(v)
        else:
            expected = end.seal(v) if v.word == "seal" else end.open(v)
            seen[f"{v.word} {expected.split(' ')[0].split('=')[0]}"] += 1
        assert v.answer == expected, f"frames.txt:{v.line}"
    errors = ("ok", "bad-length", "bad-version", "bad-session", "replayed", "bad-tag")
    assert set(seen) == {"seal frame", "seal refused", *(f"open {error}" for error in errors)}
    assert seen["open ok"] > 100 and seen["open replayed"] > 50


# ---- the handshake: AKEP2 as handshake.h lays it out


def ended(body: bytes) -> bytes:
    """46 bytes; Python's own CRC-32 is that of IEEE 802.3."""
    body = body.ljust(42, b"\0")
    return body + zlib.crc32(body).to_bytes(4, "little")


def is_whole(frame: bytes) -> bool:
    return len(frame) == 46 and zlib.crc32(frame[:42]).to_bytes(4, "little") == frame[42:]


def derived(v: Vector, *labels: int, device: bytes = b"") -> bytes:
    context = v.bytes("host") + (device or v.bytes("device"))
    key = v.bytes("key")
    return b"".join(siphash(key, bytes([n]) + context).to_bytes(8, "little") for n in labels)


def judge_crc(v: Vector) -> str:
    return f"crc={zlib.crc32(v.bytes('message'))}"


def judge_nonce(v: Vector) -> str:
    nonce = v.number("boot").to_bytes(4, "little") + v.number("session").to_bytes(4, "little")
    return f"nonce={nonce.hex()}{v.bytes('random')[::-1].hex()}"


def judge_hello_encode(v: Vector) -> str:
    return f"frame={ended(bytes([1, 6]) + v.bytes('host')).hex()}"


def judge_hello_decode(v: Vector) -> str:
    frame = v.bytes("frame")
    return f"host={frame[2:18].hex()}" if is_whole(frame) and frame[1] == 6 else "malformed"


def judge_welcome_encode(v: Vector) -> str:
    body = bytes([1, 7]) + v.bytes("host") + v.bytes("device") + derived(v, 1)
    return f"frame={ended(body).hex()}"


def judge_welcome_decode(v: Vector) -> str:
    frame, device = v.bytes("frame"), bytes(16)
    if not is_whole(frame):
        foreign = len(frame) != 46 and frame[1:2] not in (b"", b"\7")
        verdict = "other" if foreign else "noise"
    elif frame[0] != 1:
        verdict = "version"
    elif frame[1] != 7:
        verdict = "other"
    elif frame[2:18] != v.bytes("host"):
        verdict = "stale"
    elif frame[34:42] != derived(v, 1, device=frame[18:34]):
        verdict = "wrong-key"
    else:
        verdict, device = "ok", frame[18:34]
    return f"{verdict} host={v.given['host']} device={device.hex()}"


def judge_handshake(v: Vector) -> str:
    to_device, to_host = derived(v, 3, 4).hex(), derived(v, 5, 6).hex()
    number = int.from_bytes(derived(v, 2)[:4], "little")
    keys = (to_device, to_host) if v.given["at"] == "host" else (to_host, to_device)
    return f"number={number} send_key={keys[0]} receive_key={keys[1]}"


def test_every_verdict_on_a_handshake_is_there() -> None:
    rows = list(read(VECTORS / "handshakes.txt"))
    found = {v.answer.split(" ")[0] for v in rows if v.word == "welcome-decode"}
    assert found == {"ok", "noise", "other", "version", "stale", "wrong-key"}
    assert {v.given["at"] for v in rows if v.word == "handshake"} == {"host", "device"}


# ---- payloads


class MalformedError(Exception):
    """A payload that no encoder wrote."""


@dataclass
class Reader:
    """Takes a payload apart from its beginning."""

    data: bytes
    at: int = 0

    def take(self, size: int, signed: bool = False) -> int:
        if self.at + size > len(self.data):
            raise MalformedError
        self.at += size
        return int.from_bytes(self.data[self.at - size : self.at], "little", signed=signed)

    def time(self) -> int:
        value = self.take(8, signed=True)
        if abs(value) > TIME_MAX:
            raise MalformedError
        return value

    def varint(self) -> int:
        """Zigzag in groups of seven bits: at most ten, of which 64 bits count."""
        groups = [self.take(1)]
        while groups[-1] >= 0x80 and len(groups) < 10:
            groups.append(self.take(1))
        if groups[-1] >= 0x80:
            raise MalformedError
        zigzag = sum((g & 0x7F) << 7 * i for i, g in enumerate(groups)) % (1 << 64)
        return -(zigzag + 1) // 2 if zigzag % 2 else zigzag // 2

    def done(self) -> None:
        if self.at != len(self.data):
            raise MalformedError


def zigzag(value: int) -> bytes:
    """A varint."""
    groups, rest = [], 2 * value if value >= 0 else -2 * value - 1
    while True:
        groups.append(rest % 128)
        rest //= 128
        if not rest:
            return bytes([g + 128 for g in groups[:-1]] + groups[-1:])


def little(value: int, size: int) -> bytes:
    return (value % (1 << 8 * size)).to_bytes(size, "little")


STAMPS = ("received_us", "sent_us")  # behind the count that is echoed


def fitting(v: Vector, payload: bytes | None) -> str:
    if payload is None or len(payload) > v.number("capacity"):
        return "refused"
    return f"payload={payload.hex()}"


def mark(v: Vector) -> bytes:
    number, width_us = v.number("mark_number"), v.number("mark_width_us")
    return little(number, 2) + little(width_us, 2) + little(v.number("mark_least_us"), 8)


def stamps(v: Vector) -> bytes:
    times = b"".join(little(v.number(n), 8) for n in STAMPS)
    return little(v.number("echo_us"), 4) + times + mark(v)


def told_stamps(reader: Reader) -> str:
    echo = f"echo_us={reader.take(4)}"
    times = " ".join(f"{name}={reader.time()}" for name in STAMPS)
    number, width_us, least_us = reader.take(2), reader.take(2), reader.time()
    told = f"mark_number={number} mark_width_us={width_us} mark_least_us={least_us}"
    return f"{echo} {times} {told}"


def judge_varint_encode(v: Vector) -> str:
    return fitting(v, zigzag(v.number("value")))


def judge_varint_decode(v: Vector) -> str:
    return f"value={Reader(v.bytes('payload')).varint()}"


def judge_bytes_encode(v: Vector) -> str:
    return fitting(v, v.bytes("bytes"))


def judge_bytes_decode(v: Vector) -> str:
    payload, count = v.bytes("payload"), v.number("count")
    return f"bytes={payload[:count].hex()}" if count <= len(payload) else "malformed"


def judge_sync_encode(v: Vector) -> str:
    return fitting(v, stamps(v))


def judge_sync_decode(v: Vector) -> str:
    reader = Reader(v.bytes("payload"))
    text = told_stamps(reader)
    reader.done()
    return text


def judge_plan_encode(v: Vector) -> str:
    tracks, count = v.number("tracks"), v.number("count")
    if not (3 <= count <= 128 and 0 < tracks < 32):
        return "refused"
    payload = stamps(v) + little(v.number("number"), 4) + little(v.number("epoch"), 2)
    payload += little(v.number("first_knot"), 8)
    payload += bytes([tracks, count])
    for i, sink in enumerate(SINKS):
        if tracks >> i & 1:
            points = (v.numbers(sink) + [0] * 128)[:count]
            first = [b - a for a, b in pairwise([0, *points])]
            second = [b - a for a, b in pairwise([0, *first])]
            payload += zigzag(points[0]) + b"".join(map(zigzag, [first[1], *second[2:]]))
    return fitting(v, payload)


def runs(values: list[int]) -> str:
    """As numbers() reads it."""
    parts: list[tuple[int, int]] = []
    for value in values:
        if parts and parts[-1][0] == value:
            parts[-1] = value, parts[-1][1] + 1
        else:
            parts.append((value, 1))
    return ",".join(f"{value}*{times}" if times > 1 else f"{value}" for value, times in parts)


def judge_plan_decode(v: Vector) -> str:
    reader = Reader(v.bytes("payload"))
    text = told_stamps(reader)
    number, epoch, first_knot = reader.take(4), reader.take(2), reader.take(8, signed=True)
    tracks, count = reader.take(1), reader.take(1)
    if not (3 <= count <= 128 and 0 < tracks < 32):
        raise MalformedError
    text += f" number={number} epoch={epoch} first_knot={first_knot} tracks={tracks} count={count}"
    for i, sink in enumerate(SINKS):
        if not tracks >> i & 1:
            continue
        coded = [reader.varint() for _ in range(count)]
        first = coded[:2]
        for second in coded[2:]:
            first.append(first[-1] + second)
        points = [sum(first[: k + 1]) for k in range(count)]
        if any(not -INT32_MAX - 1 <= p <= INT32_MAX for p in points):
            raise MalformedError
        text += f" {sink}={runs(points)}"
    reader.done()
    return text


STATUS = (
    *(("sent_count_us", 4), ("least_error_ns", 4), ("most_error_ns", 4), ("rate_q32", 4)),
    *(("heard_us", 8), ("heard_age_us", 4)),
    *(("mark_number", 2), ("mark_width_us", 2), ("mark_least_us", 8)),
    *(("state", 1), ("refusal", 1), ("flags", 1), ("epoch", 2), ("command_number", 4)),
    *(("command_result", 1), ("holding_tq", 4), ("fault_reason", 1), ("fault_state", 1)),
    *(("fault_boots", 4), ("fault_time_us", 8), ("fault_value", 4), ("fault_limit", 4)),
    *(("fault_position_pq", 4), ("fault_torque_tq", 4), ("plan_seen", 4), ("plan_accepted", 4)),
    *(("accepted_mask", 4), ("plans_accepted", 4), ("plans_late", 4), ("plans_refused", 4)),
    *(("frames_bad", 4), ("coasts", 4), ("stamps_excluded", 4)),
    *(("torque_peak_tq", 4), ("torque_clipped", 4), ("sample_count", 1)),
)


FLAGS = ("synced", "homed", "released", "grouped")
SIGNED = {
    name
    for name, _ in STATUS
    if name.endswith(
        ("_tq", "_ns", "rate_q32", "heard_us", "least_us", "time_us", "value", "limit", "_pq")
    )
}


def judge_status_encode(v: Vector) -> str:
    count, sent_us = v.number("sample_count"), v.number("sent_us")
    if count > 32:
        return "refused"
    payload = little(sent_us, 8)
    flags = sum(v.number(name) << i for i, name in enumerate(FLAGS))
    for name, size in STATUS:
        payload += little(flags if name == "flags" else v.number(name), size)
    times = [sent_us, *(sent_us - age for age in v.numbers("ages_us"))]
    counts = [0, *v.numbers("counts")]
    for i in range(count):
        payload += zigzag(times[i + 1] - times[i]) + zigzag(counts[i + 1] - counts[i])
    return fitting(v, payload)


def wrapped(value: int, bits: int) -> int:
    """Two's complement."""
    half = 1 << (bits - 1)
    return (value + half) % (1 << bits) - half


def judge_status_decode(v: Vector) -> str:
    reader = Reader(v.bytes("payload"))
    time_us, count = reader.take(8, signed=True), 0
    text = f"sent_us={time_us}"
    for name, size in STATUS:
        value = reader.take(size, signed=name in SIGNED)
        if name == "flags":
            text += "".join(f" {flag}={value >> i & 1}" for i, flag in enumerate(FLAGS))
        else:
            text += f" {name}={value}"
    if value > 32:
        raise MalformedError
    counts = []
    for _ in range(value):
        time_us = wrapped(time_us + reader.varint(), 64)
        count += reader.varint()
        counts.append(wrapped(count, 32))
        text += f" time_us={time_us}"
    reader.done()
    return f"{text} counts={runs(counts)}"


BYTES: dict[str, Callable[[Vector], str]] = {
    "cobs-encode": judge_cobs_encode,
    "cobs-decode": judge_cobs_decode,
    "siphash": judge_siphash,
    "crc": judge_crc,
    "nonce": judge_nonce,
    "hello-encode": judge_hello_encode,
    "hello-decode": judge_hello_decode,
    "welcome-encode": judge_welcome_encode,
    "welcome-decode": judge_welcome_decode,
    "handshake": judge_handshake,
    "varint-encode": judge_varint_encode,
    "varint-decode": judge_varint_decode,
    "bytes-encode": judge_bytes_encode,
    "bytes-decode": judge_bytes_decode,
    "sync-encode": judge_sync_encode,
    "sync-decode": judge_sync_decode,
    "plan-encode": judge_plan_encode,
    "plan-decode": judge_plan_decode,
    "status-encode": judge_status_encode,
    "status-decode": judge_status_decode,
}


@pytest.mark.parametrize(
    "stem",
    [
        "cobs",
        "siphash",
        "handshakes",
        "groups",
        "peers",
        "varints",
        "syncs",
        "plans",
        "statuses",
        "commands",
    ],
)
def test_bytes_are_what_the_layout_says(stem: str) -> None:
    seen: Counter[str] = Counter()
    for v in read(VECTORS / f"{stem}.txt"):
        try:
            expected = BYTES[v.word](v)
        except MalformedError:
            expected = "malformed"
        assert v.answer == expected, f"{stem}.txt:{v.line}"
        seen[f"{v.word} {expected.split(' ')[0].split('=')[0]}"] += 1
    assert len(seen) >= {"siphash": 1, "handshakes": 12}.get(stem, 2), seen


def test_the_papers_own_hashes_are_there() -> None:
    """Appendix A: key 00 .. 0f, message 00 .. 0e."""
    assert siphash(bytes(range(16)), bytes(range(15))) == 0xA129CA6149BE45E5
    found = {v.given["message"]: v.answer for v in read(VECTORS / "siphash.txt")}
    assert found[bytes(range(1, 15)).hex()] == "hash=a129ca6149be45e5"


def test_fixed_point_numbers_are_the_exact_ones_rounded_down() -> None:
    saturated = 0
    for v in read(VECTORS / "fixed.txt"):
        name, _, text = v.answer.partition("=")
        if v.word == "fixed-sum":
            a, b = v.number("a"), v.number("b")
            assert v.answer == f"sum={wrapped(a + b, 32)} difference={wrapped(a - b, 32)}"
            continue
        if v.word == "fixed-mul-u16":
            assert v.answer == f"product={v.number('a') * v.number('b')}", v
            continue
        if v.word == "fixed-mul-u32":
            assert v.answer == f"product={v.number('a') * v.number('b'):016x}", v
            continue
        if v.word.startswith("fixed-clamp"):
            limit = v.number("limit")
            assert int(text) == sorted((-limit, v.number("value"), limit))[1]
            continue
        shift, got = v.number("shift"), int(text)
        exact = v.number("value") * v.number("mantissa") >> shift
        nearly = INT32_MAX - max(0, (1 << 16 >> shift))  # from here on fixed.h may saturate
        assert name == "product"
        if abs(exact) > INT32_MAX:
            assert got == (INT32_MAX if exact > 0 else -INT32_MAX), v
        elif shift >= 16 or abs(exact) < nearly:
            assert got == exact, v
        else:
            assert got in (exact, INT32_MAX, -INT32_MAX) and got * exact > 0, v
        saturated += abs(got) == INT32_MAX
    assert saturated > 100


# ---- tracks and the gate


@dataclass
class Ring:
    """A stored track as track.h says: the last 256 points; beyond the last one it repeats it."""

    end: int = 0
    points: dict[int, int] = field(default_factory=dict)

    def write(self, first: int, points: list[int]) -> None:
        if not self.points:
            self.points = {first - i: points[0] for i in range(1, 257)}
        self.points |= {first + i: p for i, p in enumerate(points)}
        self.end = first + len(points) - 1
        self.points = {k: p for k, p in self.points.items() if self.end - 256 < k <= self.end}

    def at(self, knot: int) -> int | None:
        """None: forgotten."""
        if not self.points:
            return 0
        knot = min(knot, self.end)
        return self.points.get(knot)


@dataclass
class Limits:
    """Of a sink's points, per knot interval."""

    low: int
    high: int
    first: int
    second: int
    stop: int = 0  # second difference of the stop ramp
    continuous: int = 0

    @property
    def valid(self) -> bool:
        """What the gate's arithmetic can bear."""
        ends = -(1 << 30) < self.low <= self.high < 1 << 30
        return ends and 0 < self.first <= 1 << 25 and self.second > 0 and 0 <= self.stop <= 1 << 26


@dataclass
class World:
    """What the lines so far have stored."""

    rings: dict[str, Ring] = field(default_factory=lambda: {s: Ring() for s in SINKS})
    limits: dict[str, Limits] = field(default_factory=dict)

    def take(self, v: Vector) -> bool:
        """Whether the line is one of those that store."""
        if v.word == "blank":
            self.rings, self.limits = {s: Ring() for s in SINKS}, {}
        elif v.word == "store":
            self.rings[v.given["sink"]].write(v.number("first_knot"), v.numbers("points"))
        elif v.word == "limits":
            names = ("point_min", "point_max", "difference_max", "second_max", "stop", "continuous")
            self.limits[v.given["sink"]] = Limits(*(v.number(name) for name in names))
        else:
            return False
        return True


def unwound(points: list[int]) -> list[int]:
    """Points of an axis without ends, each next to the one before it."""
    found = points[:1]
    for point in points[1:]:
        found.append(found[-1] + wrapped(point - found[-1], 32))
    return found


def de_boor(points: list[int], u: Fraction) -> tuple[Fraction, Fraction, Fraction]:
    """Value and two derivatives at u in [0, 1) of four points' uniform cubic B-spline.

    de Boor, A Practical Guide to Splines, chapter X: differences of the points are the points of
    the derivative; a value is interpolated level by level. The knots are -2 .. 3.
    """

    def interpolated(level: list[Fraction]) -> Fraction:
        degree = len(level) - 1
        for r in range(degree, 0, -1):
            # the interval [0, 1) is the last of the r before and the first of the r after it
            left = [Fraction(i + 1 - r) for i in range(r)]
            level = [
                ((u - low) * b + (low + r - u) * a) / r
                for low, (a, b) in zip(left, pairwise(level), strict=True)
            ]
        return level[0]

    first = [Fraction(b - a) for a, b in pairwise(points)]
    second = [b - a for a, b in pairwise(first)]
    return interpolated([Fraction(p) for p in points]), interpolated(first), interpolated(second)


def test_tracks_are_the_splines_rounded_down() -> None:
    """Within the bounds that track.h states."""
    world, evaluated, resting = World(), 0, 0
    for v in read(VECTORS / "tracks.txt"):
        if world.take(v) or v.word == "track-past":
            continue
        ring = world.rings[v.given["sink"]]
        got = dict(part.split("=") for part in v.answer.split(" "))
        if v.word == "track-point":
            expected = ring.at(v.number("knot"))
            assert expected is None or int(got["point"]) == expected, v
            continue
        time_us, shift = v.number("time_us"), v.number("knot_shift")
        knot, phase = divmod(time_us, 1 << shift)
        points = [p for k in range(knot - 1, knot + 3) if (p := ring.at(k)) is not None]
        if len(points) < 4:
            continue  # forgotten ones
        points = unwound(points)
        exact = de_boor(points, Fraction(phase, 1 << shift))
        errors = [
            int(got[name]) - x for name, x in zip(("value", "rate", "curve"), exact, strict=True)
        ]
        bends = [
            abs(a - 2 * b + c) for a, b, c in zip(points, points[1:], points[2:], strict=False)
        ]
        off = Fraction(max(bends), 3 << 18)
        errors[0] = (errors[0] + (1 << 31)) % (1 << 32) - (1 << 31)  # it is modulo 2^32
        assert -(1 if phase == 0 else 6) - off < errors[0] <= off, v
        assert -Fraction(5, 2) < errors[1] <= 0, v
        assert -1 < errors[2] <= 0, v
        if len(set(points)) == 1:
            assert errors == [0, 0, 0], v
            resting += 1
        evaluated += 1
    assert evaluated > 1000 and resting > 100


def test_the_past_of_tracks() -> None:
    """It is there where the ring has all points that were written, and what was there is right."""
    world, written, there, gone = World(), set[int](), 0, 0
    for v in read(VECTORS / "tracks.txt"):
        if world.take(v):
            if v.word == "blank":
                written = set()
            elif v.given["sink"] == "position":
                written |= {v.number("first_knot") + i for i in range(len(v.numbers("points")))}
            continue
        if v.word != "track-past":
            continue
        ring = world.rings["position"]
        knot, phase = divmod(v.number("time_us"), 1 << v.number("knot_shift"))
        points = [ring.at(k) for k in range(knot - 1, knot + 3)]
        live = {min(k, ring.end) for k in range(knot - 1, knot + 3)}
        if knot > ring.end or None in points or not live <= written:
            assert v.answer == "gone", v
            gone += 1
            continue
        known = [p for p in points if p is not None]
        exact, _, _ = de_boor(known, Fraction(phase, 1 << v.number("knot_shift")))
        assert -7 < int(v.answer.removeprefix("value=")) - exact <= 1, v
        there += 1
    assert there > 40 and gone > 50


@dataclass
class Offer:
    """One track of a plan, offered in the interval of `knot`."""

    limits: Limits
    ring: Ring
    first_knot: int
    points: list[int]
    knot: int

    def before(self, k: int) -> int | None:
        return self.ring.at(k)

    def after(self, k: int) -> int | None:
        """The point once the plan is taken."""
        if k >= self.first_knot:
            return self.points[min(k - self.first_knot, len(self.points) - 1)]
        return self.ring.at(k) if self.ring.points else self.points[0]

    def faults(self) -> set[str]:
        """All that gate.h has a name for."""
        found = set()
        end = self.first_knot + len(self.points) - 1
        if self.limits.first <= 0:
            found.add("sink")
        if self.ring.points:
            if not self.knot - 126 < self.first_knot <= self.ring.end + 1:
                found.add("gap")
            low = max(self.first_knot, self.knot - 126)
            if any(self.before(k) != self.after(k) for k in range(low, self.knot + 3)):
                found.add("late")
        elif self.first_knot < self.knot + 3:
            found.add("late")
        if end >= self.knot + 128:
            found.add("far")
        if len(set(self.points[-3:])) != 1:
            found.add("rest")
        within = all(self.limits.low <= p <= self.limits.high for p in self.points)
        if not within and not self.limits.continuous:
            found.add("range")
        if "gap" in found:
            return found  # what it would follow is unknown
        around = [self.after(k) for k in range(self.first_knot - 2, end + 3)]
        numbers = unwound([p for p in around if p is not None])
        if not (self.limits.continuous or all(map(self.has_room, self.spans(end)))):
            found.add("room")
        first = [b - a for a, b in pairwise(numbers)]
        if any(abs(d) > self.limits.first for d in first[1:]):
            found.add("speed")
        if any(abs(b - a) > self.limits.second for a, b in pairwise(first)):
            found.add("acceleration")
        return found

    def spans(self, end: int) -> list[list[int]]:
        """The four live points of each interval that a new point completes."""
        rows = [[self.after(k + i) for i in range(-3, 1)] for k in range(self.first_knot, end + 1)]
        return [[p for p in row if p is not None] for row in rows]

    def has_room(self, span: list[int]) -> bool:
        """Towards both ends: the way to stop from the largest difference, behind every point."""
        if self.limits.stop == 0:
            return True
        up = max(0, *(b - a for a, b in pairwise(span)))
        down = max(0, *(a - b for a, b in pairwise(span)))
        way_up, way_down = (Fraction(d * d, 2 * self.limits.stop) for d in (up, down))
        return max(span) + way_up <= self.limits.high and min(span) - way_down >= self.limits.low

    def assert_safe(self) -> None:
        """The accepted curve in eighths of an interval: exact numbers, 6 * 8^3 times as large."""
        low = max(self.first_knot - 1, self.knot - 100)
        high = max(self.first_knot + len(self.points), self.knot) + 2
        for knot in range(low, high):
            points = [p for k in range(knot - 1, knot + 3) if (p := self.after(k)) is not None]
            old = [self.before(k) for k in range(knot - 1, knot + 3)]
            if knot <= self.knot and self.ring.points:
                assert points == old  # what runs now goes on as it did
            for u in range(8):
                w = 8 - u
                cubic = w**3, 3 * u**3 - 48 * u**2 + 2048, 3 * w**3 - 48 * w**2 + 2048, u**3
                value = sum(a * b for a, b in zip(cubic, points, strict=True))
                points = unwound(points)
                value = sum(a * b for a, b in zip(cubic, points, strict=True))
                ends = self.limits.low * 3072, self.limits.high * 3072
                assert self.limits.continuous or ends[0] <= value <= ends[1]
                d = [b - a for a, b in pairwise(points)]
                rate = w * w * d[0] + (128 - w * w - u * u) * d[1] + u * u * d[2]
                assert abs(rate) <= self.limits.first * 128
                if knot >= self.first_knot - 1 and not self.limits.continuous and self.limits.stop:
                    left = (ends[1] - value if rate > 0 else value - ends[0]) * 2 * self.limits.stop
                    assert rate * rate * 3072 <= left * 128 * 128
                curve = w * (d[1] - d[0]) + u * (d[2] - d[1])
                assert abs(curve) <= self.limits.second * 8
        assert len(set(points)) == 1  # and it ends at rest


def test_the_gate_decides_by_its_definition() -> None:
    world, seen = World(), Counter[str]()
    none = Limits(0, 0, 0, 0)
    for v in read(VECTORS / "gates.txt"):
        if world.take(v):
            continue
        if v.word == "limits-valid":
            names = ("point_min", "point_max", "difference_max", "second_max", "stop")
            assert v.answer == f"valid={int(Limits(*map(v.number, names)).valid)}", v
            continue
        assert v.word == "gate"
        seen[v.answer] += 1
        mask, count = v.number("tracks"), v.number("count")
        if not mask & 1:
            assert v.answer == "sink", v
            continue
        offers = [
            Offer(
                world.limits.get(sink, none),
                world.rings[sink],
                v.number("first_knot"),
                (v.numbers(sink) + [0] * 128)[:count],
                v.number("knot"),
            )
            for i, sink in enumerate(SINKS)
            if mask >> i & 1
        ]
        faults = next((found for offer in offers if (found := offer.faults())), set())
        if v.answer == "accepted":
            assert not faults, v
            for offer in offers:
                offer.assert_safe()
        else:
            assert v.answer in faults, (v, faults)
    assert seen["accepted"] > 500
    for reason in ("late", "gap", "far", "range", "speed", "acceleration", "rest", "sink", "room"):
        assert seen[reason] > 25, seen


# ---- what starts and stops an axis

STATES = ["boot", "unsynced", "idle", "armed", "running", "coast", "tail", "hold", "fault", "estop"]
EVENTS = [
    "booted",
    "synced",
    "sync-lost",
    "arm",
    "disarm",
    "plan",
    "overdue",
    "rested",
    "resume",
    "stop",
    "fault",
    "clear",
    "estop",
]
EXITS = {
    "boot": {"booted": "unsynced"},
    "unsynced": {"synced": "idle"},
    "idle": {"sync-lost": "unsynced", "arm": "armed"},
    "armed": {"sync-lost": "tail", "disarm": "idle", "plan": "running", "stop": "tail"},
    "running": {"sync-lost": "tail", "plan": "running", "overdue": "coast", "stop": "tail"},
    "coast": {"plan": "running", "rested": "hold", "stop": "tail"},
    "tail": {"rested": "hold"},
    "hold": {"disarm": "idle", "resume": "armed", "stop": "tail"},
    "fault": {"clear": "unsynced"},
    "estop": {"clear": "unsynced"},
}


def test_states_have_the_exits_of_the_design() -> None:
    """Any state goes to FAULT but a stopped one, and any to ESTOP."""
    seen = 0
    for v in read(VECTORS / "states.txt"):
        state, event = STATES[v.number("state")], EVENTS[v.number("event")]
        after = EXITS[state].get(event, state)
        if event == "estop":
            after = "estop"
        elif event == "fault" and state not in ("fault", "estop"):
            after = "fault"
        assert v.answer == f"state={STATES.index(after)}", (state, event)
        seen += 1
    assert seen == len(STATES) * len(EVENTS)


def judge_command_encode(v: Vector) -> str:
    payload = little(v.number("number"), 4) + little(v.number("kind"), 1)
    payload += little(v.number("argument"), 4) + little(v.number("epoch"), 2)
    return fitting(v, payload)


def judge_command_decode(v: Vector) -> str:
    reader = Reader(v.bytes("payload"))
    text = f"number={reader.take(4)} kind={reader.take(1)} "
    text += f"argument={reader.take(4, signed=True)} epoch={reader.take(2)}"
    reader.done()
    return text


BYTES |= {"command-encode": judge_command_encode, "command-decode": judge_command_decode}

FAULT = (("reason", 1), ("state", 1), ("boots", 4), ("time_us", 8))
FAULT_SIGNED = ("value", "limit", "position_pq", "torque_tq")
RESPONSES = ["tail"] * 10 + ["fault"] * 6 + ["brake"] * 5


def test_faults_are_logged_in_a_ring_of_eight() -> None:
    entries: list[bytes] = []
    decoded = 0
    for v in read(VECTORS / "faults.txt"):
        if v.word == "fault-response":
            assert v.answer == RESPONSES[v.number("reason")]
        elif v.word == "faults-blank":
            entries = []
        elif v.word == "fault-add":
            entry = b"".join(little(v.number(name), size) for name, size in FAULT)
            entries.append(entry + b"".join(little(v.number(name), 4) for name in FAULT_SIGNED))
        elif v.word == "faults-encode":
            ring = [b"".join(entries[i::8][-1:]) or bytes(30) for i in range(8)]
            assert v.answer == fitting(v, little(len(entries), 4) + b"".join(ring)), v
        else:
            payload = v.bytes("payload")
            text = "malformed"
            if len(payload) == 4 + 8 * 30:
                reader = Reader(payload)
                text = f"count={reader.take(4)}"
                for _ in range(8):
                    head = [reader.take(1), reader.take(1)]
                    text += f" boots={reader.take(4)} time_us={reader.take(8, signed=True)}"
                    rest = [reader.take(4, signed=True) for _ in FAULT_SIGNED]
                    text += f" fault={runs(head + rest)}"
                decoded += 1
            assert v.answer == text, v
    assert decoded == 1 and len(entries) > 16


def test_ramps_come_to_rest_at_a_constant_deceleration() -> None:
    """In closed form, v^2 - (v - n a)^2 = 2 a way, but for the last bit of each period's way."""
    rested = 0
    for v in read(VECTORS / "ramps.txt"):
        if v.word == "ramp-start":
            start = v.number("position_pq") << 16
            velocity = v.number("velocity_pq") << 16
            torque, end = v.number("torque_tq"), v.number("end_torque_tq")
            steps = 0
        else:
            steps += v.number("times")
        a = v.number("deceleration_q16") if steps else 1
        n = min(steps, abs(velocity) // a)
        sign = 1 if velocity > 0 else -1
        lost = (a + 1) // 2  # of a period's way to its deceleration; halves are rounded down
        way = n * abs(velocity) - a * n * (n - 1) // 2 - n * lost
        way = sign * (way + ((abs(velocity) - n * a) // 2 if steps > n else 0))
        left = 0 if steps > n else velocity - sign * n * a
        if steps and steps == n and abs(velocity) == n * a:
            left = 0
        change = steps * (v.number("torque_step_tq") if steps else 0)
        now = end if abs(end - torque) <= change else torque + (change if end > torque else -change)
        rests = int(steps > 0 and left == 0 and now == end)
        position = wrapped((start + way) >> 16, 32)
        text = f"position_pq={position} velocity_pq={left >> 16} torque_tq={now} resting={rests}"
        assert v.answer == text, (v, steps)
        rested += rests
    assert rested > 50


def test_gaps_are_filled_by_their_policies() -> None:
    tracks = {sink: Ring() for sink in SINKS}
    seen: Counter[str] = Counter()
    for v in read(VECTORS / "gaps.txt"):
        if v.word == "gap-policy":
            sink, policy = v.number("sink"), v.number("policy")
            allowed = {
                0: {0, 1, 4},
                1: {0, 2, 4} | ({3} if not v.number("carries_gravity") else set()),
            }
            assert v.answer == f"valid={int(policy in allowed.get(sink, {0, 2, 4}))}", v
            continue
        if v.word == "gap-blank":
            tracks = {sink: Ring() for sink in SINKS}
            continue
        given = [sink for sink in SINKS if sink in v.given]
        if v.word == "gap-store":
            for sink in given:
                tracks[sink].write(v.number("first_knot"), v.numbers(sink))
            continue
        first, policies = v.number("first_knot"), v.numbers("policies")
        open_ = {s: range(tracks[s].end + 1, first) for s in given if tracks[s].points}
        open_ = {sink: knots for sink, knots in open_.items() if knots}
        stern = {policies[SINKS.index(sink)] for sink in open_}
        verdict = 4 if 4 in stern else 1 if 1 in stern else 0
        low = min((knots[0] for knots in open_.values()), default=first)
        text = f"missing={first - low} verdict={verdict}"
        if first - low + v.number("count") > 128:
            assert v.answer == text + (" no-room" if first - low <= 128 else ""), v
            seen["no-room"] += 1
            continue
        text += f" first_knot={low}"
        for sink in given:
            points, ring = v.numbers(sink), tracks[sink]
            policy = policies[SINKS.index(sink)]
            filled = []
            for knot in range(low, first):
                if not ring.points:
                    filled.append(points[0])
                elif knot <= ring.end:
                    filled.append(ring.at(knot) or 0)
                elif policy in (2, 3):
                    filled.append((ring.at(ring.end) or 0) if policy == 2 else 0)
                else:
                    last = ring.at(ring.end) or 0
                    rise = Fraction(
                        wrapped(points[0] - last, 32) * (knot - ring.end), first - ring.end
                    )
                    filled.append(wrapped(last + int(rise), 32))  # int: towards zero
                    seen["line"] += 1
            text += f" {sink}={runs(filled + points)}"
        assert v.answer == text, v
    assert seen["line"] > 100 and seen["no-room"] > 3


def test_homing_finds_its_mark_and_comes_to_rest() -> None:
    """Beside the setpoint, the marks of the whole search are kept and looked at anew each time."""
    seen: Counter[str] = Counter()
    for v in read(VECTORS / "homing.txt"):
        if v.word == "home-begin":
            task, method, top = v.number("task"), v.number("method"), v.number("speed_q16")
            search = -top if v.number("backwards") else top
            rate, way, still = (
                v.number(n) for n in ("acceleration_q16", "way_counts", "still_periods")
            )
            mark_count, first = v.number("mark_count"), v.number("count")
            setpoint, speed, at_mark = v.number("position_pq") << 16, 0, None
            jog = sorted((-top, v.number("jog_q16"), top))[1]
            history: list[Vector] = []
            assert v.answer == f"position_pq={setpoint >> 16} velocity_pq=0", v
            continue
        history.append(v)
        target = jog if task == 2 else search
        if task == 1 and at_mark is None:
            if abs(wrapped(v.number("count") - first, 32)) > way:
                text = f"failed position_pq={wrapped(setpoint >> 16, 32)} velocity_pq={speed >> 16}"
                assert v.answer == text, v
                seen["failed"] += 1
                continue
            off = [i for i, h in enumerate(history) if not h.number("on_switch")]
            if method == 1 and v.number("indexed"):
                at_mark = v.number("index_count")
            elif method == 2:  # on again, after it was off
                target = search if off else -search
                if off and v.number("on_switch"):
                    at_mark = v.number("count")
            elif method not in (1, 2):
                before = [first] + [h.number("count") for h in history]
                runs_ = [
                    h.number("pushing") and a == b
                    for h, (a, b) in zip(history, pairwise(before), strict=True)
                ]
                stops = runs_[::-1].index(False) if False in runs_ else len(runs_)
                if stops >= still:
                    at_mark = v.number("count")
        if at_mark is not None:
            target = 0
        speed += sorted((-rate, target - speed, rate))[1]
        setpoint += speed
        result = "done" if target == 0 and speed == 0 else "runs"
        text = f"{result} position_pq={wrapped(setpoint >> 16, 32)} velocity_pq={speed >> 16}"
        if at_mark is not None:
            text += f" offset_count={wrapped(mark_count - at_mark, 32)}"
        assert v.answer == text, v
        seen[result] += 1
    assert seen["failed"] > 10 and seen["done"] > 50 and seen["runs"] > 300


# Reasons by number, with the response to each: 0 ramp to rest, 1 ramp and output off, 2 brake.
FOLLOWING, SPEED, ROOM, TORQUE, OUTSIDE, I2T, WINDING, UNDER, OVER, LATE, STUCK, REVERSED, SPIKE = (
    *(5, 6, 7, 8, 11, 12, 13, 14, 15, 16, 17, 18, 19),
)
Found = tuple[int, int, int]  # reason, value, limit


def toward_zero(a: int, b: int) -> int:
    return a // b if a >= 0 else -(-a // b)


@dataclass
class Watcher:
    """The monitor from its definition: what fault.h and monitor.h say of each reason."""

    allowed: dict[str, int]
    load: tuple[int, int]
    count: int | None = None
    looked: int | None = None  # the count when it was last looked at whether it stands still
    speed_sum: int = 0
    behind: int = 0
    clipped: int = 0
    losses: int = 0  # sum of load^2 - 1, of all periods
    least: int = 0  # the lowest that it has been
    block: list[int] = field(default_factory=list)
    rise: Fraction = Fraction(0)
    still: tuple[int, int] | None = None  # setpoint and feedback when the count last changed
    pushed: int = 0
    under: int = 0
    over: int = 0
    chopper: bool = False

    @property
    def speed(self) -> int:
        return toward_zero(self.speed_sum, 8)

    def begin(self) -> None:
        self.behind = self.clipped = self.pushed = 0
        self.still = None

    def step(self, s: dict[str, int]) -> Found:
        """One period; the first of the sternest."""
        late = s["power"] and s["late_us"] > self.allowed["late_us"]
        found = [(LATE, s["late_us"], self.allowed["late_us"]) if late else None]
        found.append(self.encoder(s))
        if s["looks"] & 1:
            found.append(self.stuck(s))
        if s["looks"] & 2:
            found.append(self.supply(s))
        if s["looks"] & 4:
            found.append(self.heat(s))
        if s["looks"] & 8:
            found.append(self.winding())
        if s["driven"]:
            found.append(self.motion(s))
        real = [f for f in found if f]
        order = {"brake": 0, "fault": 1, "tail": 2}
        return min(real, key=lambda f: order[RESPONSES[f[0]]], default=(0, 0, 0))

    def encoder(self, s: dict[str, int]) -> Found | None:
        change = 0 if self.count is None else wrapped(s["count"] - self.count, 32)
        self.count = s["count"]
        if abs(change) > self.allowed["spike_counts"]:
            return SPIKE, change, self.allowed["spike_counts"]
        self.speed_sum += 1024 * change - self.speed
        return None

    def stuck(self, s: dict[str, int]) -> Found | None:
        moved = self.looked not in (None, s["count"])
        self.looked = s["count"]
        if not s["driven"]:
            return None
        if moved or self.still is None or s["may_stand"]:
            self.still, self.pushed = (s["setpoint_pq"], s["torque_tq"]), 0
            return None
        way = wrapped(s["setpoint_pq"] - self.still[0], 32)
        if abs(way) > self.allowed["stuck_pq"]:
            return STUCK, way, self.allowed["stuck_pq"]
        push = s["torque_tq"] - self.still[1]
        self.pushed = (
            self.pushed + s["stuck_periods"] if abs(push) >= s["torque_limit_tq"] // 2 else 0
        )
        if self.pushed > self.allowed["stuck_periods"]:
            return STUCK, self.pushed, self.allowed["stuck_periods"]
        return None

    def supply(self, s: dict[str, int]) -> Found | None:
        supply, on = s["supply_mV"], self.allowed["chopper_mV"]
        self.chopper = supply > (on - on // 64 if self.chopper else on)
        low, high = self.allowed["supply_min_mV"], self.allowed["supply_max_mV"]
        self.under = self.under + 1 if s["power"] and supply < low else 0
        self.over = self.over + 1 if s["power"] and supply > high else 0
        if self.under == 4:
            self.under = 0
            return UNDER, supply, low
        if self.over == 4:
            self.over = 0
            return OVER, supply, high
        return None

    def heat(self, s: dict[str, int]) -> Found | None:
        mantissa, shift = self.load
        torque, periods = abs(s["torque_tq"]) if s["power"] else 0, 1 << s["heat_shift"]
        load = min(torque * mantissa >> shift, 1 << 15)  # 1/256
        self.losses += (load * load - (1 << 16)) * periods
        self.least = min(self.least, self.losses)
        self.block += [load * load] * periods
        over = (self.losses - self.least) >> 16
        if over > self.allowed["overload"]:
            return I2T, over, self.allowed["overload"]
        return None

    def winding(self) -> Found | None:
        if len(self.block) >= 256:
            mean = min(sum(self.block) // 256, 1 << 30)
            change = Fraction((mean - int(self.rise // 1)) * self.allowed["heating_q16"], 1 << 16)
            self.rise += change
            self.block = []
        if self.rise // 1 > self.allowed["rise_q16"]:
            return WINDING, int(self.rise // 1), self.allowed["rise_q16"]
        return None

    def motion(self, s: dict[str, int]) -> Found | None:
        if abs(self.speed) > self.allowed["speed_pq"]:
            return SPEED, self.speed, self.allowed["speed_pq"]
        if room := self.room(s):
            return room
        error, most = s["error_pq"], self.allowed["following_pq"]
        self.behind = self.behind + 1 if abs(error) > most else 0
        if self.behind > self.allowed["following_periods"]:
            runs_away = self.speed < -1024 if error > 0 else self.speed > 1024
            against = s["feedback_tq"] > 0 if error > 0 else s["feedback_tq"] <= 0
            return (REVERSED if runs_away and against else FOLLOWING), error, most
        self.clipped = self.clipped + 1 if s["clipped"] else 0
        if self.clipped > self.allowed["torque_periods"]:
            return TORQUE, self.clipped, self.allowed["torque_periods"]
        return None

    def room(self, s: dict[str, int]) -> Found | None:
        if not (self.allowed["bounded"] and s["bounded"]):
            return None
        end = self.allowed["high_pq" if self.speed > 0 else "low_pq"]
        left = end - s["position_pq"] if self.speed > 0 else s["position_pq"] - end
        speed = min(abs(self.speed), 1 << 22)
        if left < 0:
            return OUTSIDE, s["position_pq"], end
        way = Fraction(speed * speed, 2) / Fraction(self.allowed["deceleration_q16"], 1 << 16)
        return (ROOM, s["position_pq"], end) if way > left else None


def test_the_monitor_judges_by_its_definition() -> None:
    usual: dict[str, int] = {}
    quiet: dict[str, int] = {}
    usual_load = (0, 0)
    told: Counter[int] = Counter()
    for v in read(VECTORS / "monitors.txt"):
        given = {n: int(t) for n, t in v.given.items() if n != "load_q8"}
        mantissa, shift = v.numbers("load_q8") or usual_load
        if v.word == "monitor-usual":
            usual, usual_load = given, (mantissa, shift)
        elif v.word == "monitor-quiet":
            quiet = given
        elif v.word == "monitor":
            watcher, now = Watcher(usual | given, (mantissa, shift)), dict(quiet)
        elif v.word == "monitor-begin":
            watcher.begin()
        elif v.word == "monitor-inside":
            a = watcher.allowed
            inside = not a["bounded"] or given["position_pq"] in range(
                a["low_pq"], a["high_pq"] + 1
            )
            assert v.answer == f"inside={int(inside)}", v
        else:
            times, count_step = given.pop("times", 1), given.pop("count_step", 0)
            now |= given
            periods, reason = 0, 0
            while periods < times and not reason:
                reason, value, limit = watcher.step(now)
                now["count"] = wrapped(now["count"] + count_step, 32)
                periods += 1
            text = f"periods={periods} reason={reason} "
            text += f"value={value} limit={limit} " if reason else ""
            text += f"speed_pq={watcher.speed} chopper={int(watcher.chopper)}"
            assert v.answer == text, v
            told[reason] += 1
    assert set(told) == {0, 5, 6, 7, 8, *range(11, 20)}
    assert min(told.values()) >= 4, told


# ---- the guard


@dataclass
class Timer:
    """A board's timer, as docs/device.md has it: by true times that never wrap."""

    allowed: dict[str, int]
    now: int = 0  # of the last call
    line_since: int = 0
    tripped: tuple[int, int, int, int] | None = None  # at, for how long, allowed, the brake's time
    off: bool = False

    def call(self, seen: dict[str, int]) -> str:
        self.now += (seen["count_us"] - self.now) % (1 << 32)  # less than a turn of the counter

        def since(count: int) -> int:
            return wrapped(seen["count_us"] - count, 32)

        if not seen["power"]:
            self.line_since = self.now
            return self.told(power=0, brake=1)
        if not seen["line_open"]:
            self.line_since = self.now
        if self.tripped is None:
            period, late = self.allowed["servo_period_us"], self.allowed["late_us"]
            brake = period * self.allowed["brake_periods"]
            stop = self.allowed["stop_us"] + brake + 2 * period
            judged = [(since(seen["next_servo_us"]), late)]
            if seen["state"] in (8, 9):
                judged.append((since(seen["stop_count_us"]), stop))
            judged.append((since(self.line_since % (1 << 32)), stop + period))
            over = [(lasted, most) for lasted, most in judged if lasted > most]
            if over:
                self.tripped, self.off = (self.now, *over[0], brake), False
        if self.tripped is None:
            return self.told(power=1, brake=0)
        at, _, _, brake = self.tripped
        self.off |= (self.now - at) % (1 << 32) >= brake
        return self.told(power=int(not self.off), brake=1)

    def told(self, power: int, brake: int) -> str:
        duty = 0 if brake else 99
        verdict = 0 if self.tripped is None else 1 + self.off
        outputs = f"verdict={verdict} power={power} brake={brake} duty_q15={duty}"
        if self.tripped is None:
            return outputs
        return f"{outputs} overdue_us={self.tripped[1]} limit_us={self.tripped[2]}"


def test_the_guard_is_in_time() -> None:
    usual: dict[str, int] = {}
    timer, seen, told = Timer({}), dict[str, int](), Counter[str]()
    for v in read(VECTORS / "guards.txt"):
        values = {name: int(value) for name, value in v.given.items()}
        if v.word == "guard-usual":
            usual = values
        elif v.word == "guard":
            timer = Timer(usual | values)
            seen = dict.fromkeys(
                ("power", "state", "next_servo_us", "stop_count_us", "line_open"), 0
            )
        elif v.word == "guard-release":
            timer.tripped = None
        elif v.word == "guard-assert":
            verdict = 0 if timer.tripped is None else 1 + timer.off
            power, brake = int(verdict < 2), int(verdict > 0)
            assert v.answer == f"power={power} brake={brake} duty_q15={0 if brake else 99}", v
        else:
            timer.allowed |= {name: values[name] for name in usual if name in values}
            seen |= values
            assert v.answer == timer.call(seen), v
            told[v.answer.split()[0]] += 1
    assert told["verdict=0"] > 300 and told["verdict=1"] > 50 and told["verdict=2"] > 30


# ---- a group's key


def padded(key: bytes, session_key: bytes, counter: int) -> str:
    """Masked, or unmasked, with the pad of a frame's counter."""
    words = [siphash(session_key, bytes([label]) + little(counter, 8)) for label in (2, 3)]
    pad = b"".join(little(word, 8) for word in words)
    return bytes(a ^ b for a, b in zip(key, pad, strict=True)).hex()


def judge_group_encode(v: Vector) -> str:
    key = padded(v.bytes("group_key"), v.bytes("send_key"), v.number("sent") + 1)
    rest = little(v.number("group_number"), 4) + little(v.number("group_sent"), 6)
    return fitting(v, bytes.fromhex(key) + rest)


def judge_group_decode(v: Vector) -> str:
    frame = v.bytes("frame")
    reader = Reader(frame[12:])
    masked = bytes(reader.take(1) for _ in range(16))
    number, last = reader.take(4), reader.take(6)
    reader.done()
    if number == v.number("number"):
        return "malformed"
    key = padded(masked, v.bytes("receive_key"), int.from_bytes(frame[6:12], "little"))
    end = f"{v.given['at']} number={number} send_key={key} receive_key={key}"
    return f"{end} sent=0 received={last} window={(1 << 64) - 1:016x}"


BYTES |= {"group-encode": judge_group_encode, "group-decode": judge_group_decode}


# ---- boards among themselves


def judge_peer_request_encode(v: Vector) -> str:
    body = b"\1\x0a" + little(int(v.given["nonce"], 16), 8)
    return f"frame={(body + tagged(v, body)).hex()}"


def tagged(v: Vector, body: bytes) -> bytes:
    """A hash with the label of what neighbours say, under their key."""
    return little(siphash(v.bytes("key"), b"\4" + body), 8)


def peer_frame(v: Vector, kind: int, size: int) -> Reader | None:
    """Behind version and type, if the length and these and the tag are right."""
    frame = v.bytes("frame")
    if len(frame) != size or frame[:2] != bytes([1, kind]) or frame[-8:] != tagged(v, frame[:-8]):
        return None
    return Reader(frame[:-8], 2)


def judge_peer_request_decode(v: Vector) -> str:
    reader = peer_frame(v, 10, 18)
    return f"nonce={reader.take(8):016x}" if reader else "refused"


ERRORS = ("least_error_ns", "most_error_ns")


def judge_peer_response_encode(v: Vector) -> str:
    body = b"\1\x0b" + little(int(v.given["nonce"], 16), 8)
    body += b"".join(little(v.number(name), 8) for name in STAMPS)
    body += b"".join(little(v.number(name), 4) for name in (*ERRORS, "lineage"))
    body += bytes([v.number("settled")])
    return f"frame={(body + tagged(v, body)).hex()}"


def judge_peer_response_decode(v: Vector) -> str:
    reader = peer_frame(v, 11, 47)
    if not reader:
        return "refused"
    text = f"nonce={reader.take(8):016x}"
    try:
        text += "".join(f" {name}={reader.time()}" for name in STAMPS)
    except MalformedError:
        return "refused"
    text += "".join(f" {name}={reader.take(4, True)}" for name in ERRORS)
    return f"{text} lineage={reader.take(4)} settled={reader.take(1) % 2}"


def judge_peer_feed_encode(v: Vector) -> str:
    points = v.numbers("points")
    body = b"\1\x0f" + little(v.number("number"), 2) + bytes([v.number("steps")])
    body += bytes([len(points) // 2]) + little(v.number("lineage"), 4)
    body += little(v.number("time_us"), 8) + b"".join(little(n, 4) for n in points)
    body += bytes(66 - len(body))
    return f"frame={(body + tagged(v, body)).hex()}"


def judge_peer_feed_decode(v: Vector) -> str:
    reader = peer_frame(v, 15, 74)
    if not reader:
        return "refused"
    number, flags, count, lineage = (reader.take(n) for n in (2, 1, 1, 4))
    try:
        time_us = reader.time()
    except MalformedError:
        return "refused"
    ages = [(reader.take(4), reader.take(4, True)) for _ in range(6)][:count]
    if not 0 < count <= 6 or any(a <= b for (a, _), (b, _) in pairwise(ages)):
        return "refused"
    text = f"number={number} steps={flags % 2} lineage={lineage} time_us={time_us}"
    return text + "".join(f" at_us={time_us - age} value={value}" for age, value in ages)


BYTES |= {
    "peer-feed-encode": judge_peer_feed_encode,
    "peer-feed-decode": judge_peer_feed_decode,
    "peer-request-encode": judge_peer_request_encode,
    "peer-request-decode": judge_peer_request_decode,
    "peer-response-encode": judge_peer_response_encode,
    "peer-response-decode": judge_peer_response_decode,
}


def test_settled_times_prevail_then_old_ones_then_high_numbers() -> None:
    """Held to what must follow: nobody leaves a settled time; two never take each other's."""
    rows = {}
    for v in read(VECTORS / "lineages.txt"):
        ends = v.number("own"), v.number("other")
        settled = v.number("own_settled"), v.number("other_settled")
        ahead = v.number("ahead_least_us"), v.number("ahead_most_us")
        rows[ends, settled, ahead] = v.answer
        assert v.answer in ("joins", "stays")
    seen: Counter[str] = Counter()
    for ((own, other), settled, (least, most)), answer in rows.items():
        seen[answer] += 1
        if own == other or other == 0 or settled[0]:
            assert answer == "stays"
        elif settled == (0, 1):
            assert answer == "joins"
        elif own and (least > 0 or most < 0):  # known, whatever the numbers are
            assert answer == ("joins" if least > 0 else "stays")
        elif own:
            mirrored = rows[(other, own), settled, (least, most)]
            assert {answer, mirrored} == {"joins", "stays"}  # one of both
            assert (answer == "joins") == (other > own)
    assert seen["joins"] > 50 and seen["stays"] > 50


def test_marks_are_every_32nd_start_and_eight_are_remembered() -> None:
    noted: list[tuple[int, int]] = []
    seen: Counter[str] = Counter()
    for v in read(VECTORS / "marks.txt"):
        if v.word == "marks":
            noted = []
            continue
        number = v.number("mark_number")
        if v.word == "marks-note":
            new = number % 32 == 0 and noted[-1:] != [(number, (noted or [(0, 0)])[-1][1])]
            if new:
                noted.append((number, v.number("count_us")))
            expected = "noted" if new else "passed"
        else:
            count = dict(noted[-8:]).get(number)
            expected = "none" if count is None else f"count_us={count}"
        assert v.answer == expected, v
        seen[f"{v.word} {expected.split('=')[0]}"] += 1
    assert len(seen) == 4 and min(seen.values()) > 20


# ---- samples, the servo


def test_samples_are_reported_twice() -> None:
    taken: list[tuple[int, int]] = []
    since = last = lost = 0  # the samples of the last report, and of the one before, begin here
    for v in read(VECTORS / "histories.txt"):
        if v.word == "history":
            taken, since, last, lost = [], 0, 0, 0
        elif v.word == "history-push":
            for i in range(v.number("times")):
                lost += len(taken) - last >= 32
                taken.append((v.number("time_us") + 1000 * i, wrapped(v.number("count") + i, 32)))
            assert v.answer == f"lost={lost}", v
        elif v.word == "history-flush":
            since = last = len(taken)
            assert v.answer == f"taken={len(taken)}", v
        else:
            told = taken[since:][-32:]
            text = "".join(f"time_us={time} " for time, _ in told)
            assert v.answer == f"{text}counts={runs([count for _, count in told])}", v
            since, last = last, len(taken)
    assert lost > 30


@dataclass
class Servo:
    """servo.h in unbounded integers."""

    given: dict[str, str]
    last: int | None = None
    integral: int = 0
    differences: int = 0
    unclipped: int = 0
    saturated: bool = False

    def scaled(self, value: int, name: str) -> int:
        """As fixed.h has it: exact, but for what does not fit."""
        mantissa, shift = Settings(self.given).numbers(name, 2)
        exact = value * mantissa >> shift
        edge = 1 << 31 if shift >= 16 else (INT32_MAX >> (16 - shift)) + 1 << 16 - shift
        high = value * mantissa >> 16
        if shift < 16 and not -(edge >> 16 - shift) <= high < edge >> 16 - shift:
            return INT32_MAX if value > 0 else -INT32_MAX
        return max(-INT32_MAX, min(INT32_MAX, exact))

    def step(self) -> str:
        def clamp(value: int, most: int) -> int:
            return max(-most, min(most, value))

        def number(name: str) -> int:
            return int(self.given[name])

        limit, velocity = number("torque_limit_tq"), number("velocity_pq")
        error = wrapped(number("position_pq") - number("measured_pq"), 32)
        error = clamp(error, (1 << 29) - 1)
        change = 0 if self.last is None else error - self.last
        self.last = error
        on = (error > 0) == (self.unclipped > 0)
        if number("integrate") and not (self.saturated and on):
            self.integral += clamp(self.scaled(error, "ki"), 1 << 28)
            self.integral = clamp(self.integral, min(64 * limit, INT32_MAX))
        self.differences += change - toward_zero(self.differences, 8)
        most = 1 << 27
        emf = clamp(self.scaled(toward_zero(self.differences, 8), "emf_tq"), most)
        feedback = clamp(self.scaled(error, "kp"), most) + clamp(self.scaled(change, "kd"), most)
        feedback += self.integral // 64
        feedback = clamp(feedback + emf, number("feedback_limit_tq")) - emf
        self.unclipped = feedback + clamp(self.scaled(velocity, "velocity_tq"), most)
        self.unclipped += clamp(number("torque_tq"), most) + emf
        torque = clamp(self.unclipped, limit)
        volts = clamp(self.scaled(torque - emf, "resistance_mV"), 1 << 20)
        volts += clamp(self.scaled(velocity, "emf_mV"), 1 << 20)
        wanted = self.scaled(volts, "supply_duty")
        duty = clamp(wanted, 32767)
        self.saturated = torque != self.unclipped or duty != wanted
        return (
            f"duty_q15={duty} torque_tq={torque} unclipped_tq={self.unclipped} "
            f"feedback_tq={feedback} error_pq={error} integral={self.integral}"
        )


def test_the_servo_is_its_law_in_exact_integers() -> None:
    usual: dict[str, str] = {}
    servo, saturated = Servo({}), 0
    for v in read(VECTORS / "servos.txt"):
        if v.word == "servo-position":
            count = v.number("count")
            if not v.number("continuous"):
                count = max(-(1 << 20) + 1, min((1 << 20) - 1, count))
            assert v.answer == f"position_pq={wrapped(count * 1024, 32)}", v
        elif v.word == "servo-usual":
            usual = v.given
        elif v.word == "servo":
            servo = Servo(usual | {"measured_pq": "0"} | v.given)
        else:
            servo.given |= v.given
            for _ in range(int(v.given.get("times", 1))):
                expected = servo.step()
            assert v.answer == expected, v
            saturated += servo.saturated
    assert saturated > 100


# ---- the stepper


def stepped(v: Vector) -> tuple[dict[str, int], dict[str, int]]:
    """What a line gives, and what it answers."""
    answer = dict(part.split("=") for part in v.answer.split())
    return {k: int(x) for k, x in v.given.items()}, {k: int(x) for k, x in answer.items()}


def window(before: dict[str, int], given: dict[str, int], after: dict[str, int]) -> str:
    """Holds a window's pulses against the straight line that they follow; says what bound them."""
    least, length = given["least_q16"], given["window_us"] << 16
    steps, first, spacing = (after[name] for name in ("steps", "first_q16", "spacing_q16"))
    sign = -1 if steps < 0 else 1
    assert after["now_pq"] == before["target_pq"] and after["target_pq"] == given["target_pq"]
    assert after["count"] == wrapped(before["count"] + steps, 32)
    times = [first + i * spacing for i in range(min(abs(steps), 3))]
    times += [first + (abs(steps) - 1) * spacing] if steps else []
    assert all(0 <= t < length for t in times)
    if steps:  # the rate, within the window and from the last one
        assert first >= least - before["since_q16"]
        assert spacing >= least or abs(steps) == 1
        assert after["since_q16"] == length - times[-1]
    else:
        assert after["since_q16"] in (before["since_q16"] + length, (1 << 32) - 1)
    left = wrapped(given["target_pq"] - 1024 * after["count"], 32)
    done = -512 <= left < 512
    if not done:  # nothing else would have fitted
        # The next one is beyond the window, as the rate has it; or too far away to matter.
        toward = 1 if left > 0 else -1
        following = max(spacing, least) if steps and sign == toward else least
        at = times[-1] + following if times else max(first, least - before["since_q16"])
        assert at >= length or abs(left) >= 1 << 28
    begun = wrapped(before["target_pq"] - 1024 * before["count"], 32)
    way = wrapped(given["target_pq"] - before["target_pq"], 32)
    if done and steps and abs(begun) <= 512 and abs(way) < 1 << 29 and way * sign > 0:
        late = False
        for t in times:  # half-way between two steps, rounded down; or later, by the rate
            number = (t - first) // spacing if spacing else 0
            crossing = Fraction(length * (512 + 1024 * number - sign * begun), sign * way)
            late = late or t > crossing
            assert t >= math.floor(crossing) - number - 1 or crossing < 0
        if not late:
            return "on the line"
    return "by the rate" if steps else "none"


def test_pulses_are_where_the_line_is_half_way_between_steps() -> None:
    before: dict[str, int] = {}
    kinds = Counter[str]()
    for v in read(VECTORS / "steppers.txt"):
        given_now, after = stepped(v)
        if v.word == "stepper":
            at = given_now["position_pq"]
            assert -512 <= wrapped(at - 1024 * after["count"], 32) < 512, v
            assert (
                after["target_pq"] == after["now_pq"] == at and after["since_q16"] == (1 << 32) - 1
            )
        elif v.word == "stepper-shift":
            by = given_now["by_count"]
            assert after["since_q16"] == before["since_q16"]
            assert after["count"] == wrapped(before["count"] + by, 32), v
            for name in ("target_pq", "now_pq"):
                assert after[name] == wrapped(before[name] + 1024 * by, 32), v
        else:
            kinds[window(before, given_now, after)] += 1
        before = after
    assert min(kinds[k] for k in ("on the line", "by the rate", "none")) > 50


# ---- settings, and what is kept of them


def fields(text: str) -> list[tuple[str, int]]:
    """`name 4, other -2` by name: bytes of a number, negative where it is signed, 0 for a scale."""
    rows = (part.split() for part in text.split(","))
    return [(name, int(size)) for name, size in rows]


HEAD = fields(
    "knot_shift 1, servo_period_us 2, sample_every 2, brake_periods 2, stop_us 4, sync_lost_us 4,"
    "dither_us 2, torque_step_tq -4, knot_periods 0, offset_count -4, carries_gravity 1"
)
SERVO = fields(
    "kp_tq 0, ki_tq 0, kd_tq 0, velocity_tq 0, acceleration_tq 0, resistance_mV 0, emf_mV 0,"
    "emf_tq 0, supply_duty 0, torque_limit_tq -4, integrate_running 1, ahead_us 2"
)
MONITOR = fields(
    "following_pq -4, following_periods 2, speed_pq -4, bounded 1, low_pq -4, high_pq -4,"
    "deceleration_q16 -4, torque_periods 4, load_q8 0, overload 4, heating_q16 2, rise_q16 -4,"
    "stuck_pq -4, stuck_periods 4, spike_counts -4, supply_min_mV -4, supply_max_mV -4,"
    "chopper_mV -4, late_us 4"
)
HOME = fields(
    "home_method 1, home_backwards 1, home_mark_count -4, home_speed_q16 -4,"
    "home_acceleration_q16 -4, home_torque_tq -4, home_way_counts -4, home_still_periods 2"
)
SYNC = fields(
    "sync_method 1, among_boards 1, drift_ppm 2, wander_ppb_s 2, to_device_least_us 4,"
    "to_host_least_us 4, limit_us 4, interval_us 4, phase_gain 2, skew_gain_q8 2"
)
AMONG = fields("neighbours 1, ask_us 4, peer_least_us 4, step_least_q16 4")
BOOLEANS = {"carries_gravity", "integrate_running", "bounded", "home_backwards", "among_boards"}
PORTS = {0, 1, 2, 3, 4}  # of a board; at the first one is the host


@dataclass
class Settings:
    """A board's settings by name, as text."""

    given: dict[str, str]

    def but(self, v: Vector) -> "Settings":
        return Settings(self.given | v.given)

    def number(self, name: str) -> int:
        return int(self.given[name])

    def numbers(self, name: str, count: int) -> list[int]:
        return (Vector(0, "", self.given, "").numbers(name) + [0] * count)[:count]

    def packed(self, rows: list[tuple[str, int]]) -> bytes:
        parts = []
        for name, size in rows:
            if size:
                parts.append(little(self.number(name), abs(size)))
            else:
                mantissa, shift = self.numbers(name, 2)
                parts.append(little(mantissa, 2) + little(shift, 1))
        return b"".join(parts)

    def encoded(self, with_key: bool) -> bytes:
        keys = bytes.fromhex(self.given["key"] + self.given["peer_key"]) if with_key else b""
        out = b"\4" + keys + bytes.fromhex(self.given["name"]).ljust(26, b"\0") + self.packed(HEAD)
        out += bytes(self.numbers("gap_policy", 5))
        for sink in SINKS:
            continuous, *limits = self.numbers(sink, 6)
            out += bytes([continuous]) + b"".join(little(x, 4) for x in limits)
        return out + b"".join(map(self.packed, (SERVO, MONITOR, HOME, SYNC, AMONG)))

    def valid(self) -> bool:
        """What settings.h, gate.h, gap.h, servo.h, home.h and sync.h ask for."""
        limits = {sink: self.numbers(sink, 6) for sink in SINKS}
        for i, sink in enumerate(SINKS):
            continuous, low, high, first, second, stop = limits[sink]
            if first and not Limits(low, high, first, second, stop, continuous).valid:
                return False
            policies = {
                0: {0, 1, 4},
                1: {0, 2, 4} if self.number("carries_gravity") else {0, 2, 3, 4},
            }
            if first and self.numbers("gap_policy", 5)[i] not in policies.get(i, {0, 2, 4}):
                return False
        if self.number("bounded") and limits["position"][0]:
            return False
        scales = [name for name, size in HEAD + SERVO + MONITOR if size == 0]
        if any(self.numbers(name, 2)[1] > 31 for name in scales):
            return False
        positive = ["servo_period_us", "sample_every", "torque_step_tq", "torque_limit_tq"]
        positive += ["following_pq", "speed_pq", "stuck_pq", "deceleration_q16", "spike_counts"]
        positive += ["rise_q16", "home_acceleration_q16", "limit_us"]
        searching = ["home_speed_q16", "home_torque_tq", "home_way_counts"]
        least = dict.fromkeys(positive, 1)
        least |= dict.fromkeys(searching, 1 if self.number("home_method") else 0)
        most = {"torque_limit_tq": 1 << 25, "spike_counts": (1 << 18) - 1, "home_method": 3}
        most |= {"home_speed_q16": (1 << 30) - 1, "knot_shift": 15}
        most |= {"sync_method": 1, "drift_ppm": 300, "wander_ppb_s": 60_000}
        most |= dict.fromkeys(["to_device_least_us", "to_host_least_us", "limit_us"], 10**6)
        most |= {"peer_least_us": 10**6, "ask_us": 10**7}
        most |= {"ahead_us": 2 ** self.number("knot_shift")}
        if least_q16 := self.number("step_least_q16"):
            knot_us, period_us = 2 ** self.number("knot_shift"), self.number("servo_period_us")
            least_us = Fraction(least_q16, 65536)
            _, _, _, first, second, _ = limits["position"]
            search = Fraction(self.number("home_speed_q16"), 65536 * 1024) / period_us
            if (
                self.number("home_method") not in (1, 2)
                or 2 * period_us > knot_us
                or Fraction(first, 1024 * knot_us) * least_us > Fraction(1023, 1024)
                or Fraction(second, 1024 * knot_us**2) * period_us**2 / 8 > Fraction(1, 4)
                or search * least_us > 1
            ):
                return False
        beside = {port for port in range(8) if self.number("neighbours") >> port & 1}
        if not beside <= PORTS - {0} or (beside and self.number("ask_us") < 1000):
            return False
        return (
            all(self.number(name) >= low for name, low in (least | {"knot_shift": 9}).items())
            and all(self.number(name) <= high for name, high in most.items())
            and self.number("low_pq") <= self.number("high_pq")
            and len(bytes.fromhex(self.given["name"]).rstrip(b"\0")) < 26
        )


def decoded(data: bytes, with_key: bool, keys: dict[str, str]) -> str:
    """As the judge says settings; `keys` are those that were there."""
    reader = Reader(data)
    if reader.take(1) != 4:
        raise MalformedError
    values = dict(keys)

    def take(rows: list[tuple[str, int]]) -> None:
        for name, size in rows:
            values[name] = str(reader.take(abs(size), size < 0)) if size else ""
            if not size:
                values[name] = runs([reader.take(2), reader.take(1)])
            if name in BOOLEANS and values[name] not in "01":
                raise MalformedError

    def flag() -> int:
        value = reader.take(1)
        if value > 1:
            raise MalformedError
        return value

    for name in ("key", "peer_key") if with_key else ():
        values[name] = bytes(reader.take(1) for _ in range(16)).hex()
    values["name"] = bytes(reader.take(1) for _ in range(26)).hex()
    take(HEAD)
    values["gap_policy"] = runs([reader.take(1) for _ in range(5)])
    for sink in SINKS:
        values[sink] = runs([flag(), *(reader.take(4, True) for _ in range(5))])
    for rows in (SERVO, MONITOR, HOME, SYNC, AMONG):
        take(rows)
    reader.done()
    every = HEAD + SERVO + MONITOR + HOME + SYNC + AMONG
    order = ["name", "key", "peer_key", *(name for name, size in every if size)]
    order += [name for name, size in every if not size]
    return " ".join(f"{name}={values[name]}" for name in [*order, "gap_policy", *SINKS])


def test_settings_are_what_the_layout_says() -> None:
    usual, seen = Settings({}), Counter[str]()
    for v in read(VECTORS / "settings.txt"):
        if v.word == "settings-usual":
            usual = Settings(v.given)
            continue
        if v.word == "settings-valid":
            expected = f"valid={int(usual.but(v).valid())}"
        elif v.word == "settings-encode":
            data = usual.but(v).encoded(v.given["with_key"] == "1")
            expected = fitting(v, data).replace("payload=", "bytes=")
        else:
            try:
                keys = {name: usual.given[name] for name in ("key", "peer_key")}
                expected = decoded(v.bytes("bytes"), v.given["with_key"] == "1", keys)
            except MalformedError:
                expected = "malformed"
        assert v.answer == expected, v
        seen[f"{v.word} {expected.split('=')[0][:7]}"] += 1
    assert seen["settings-valid valid"] > 200
    assert {v.answer for v in read(VECTORS / "settings.txt")} >= {"valid=0", "valid=1"}
    assert seen["settings-decode malform"] > 10 and len(seen) == 5


@dataclass
class Memory:
    """Two places of each kind, as store.h says."""

    places: dict[int, bytes] = field(default_factory=dict)

    def good(self, first: int) -> dict[int, tuple[int, bytes]]:
        """Generation and payload of the places that are whole."""
        found = {}
        for at in (first, first + 1):
            data = self.places.get(at, b"")
            if len(data) >= 8 and zlib.crc32(data[:-4]).to_bytes(4, "little") == data[-4:]:
                found[at] = int.from_bytes(data[:4], "little"), data[4:-4]
        return found

    def load(self, first: int) -> bytes | None:
        whole = sorted(self.good(first).items(), key=lambda place: (place[1][0], -place[0]))
        return whole[-1][1][1] if whole else None

    def save(self, first: int, payload: bytes, v: Vector) -> tuple[str, int]:
        """What the board is told, and the generation, 0 if it is not there afterwards.

        It goes where the record that counts is not; with none, to the first if that is empty.
        """
        whole = sorted(self.good(first).items(), key=lambda place: (place[1][0], -place[0]))
        counts, last = (whole[-1][0], whole[-1][1][0]) if whole else (None, 0)
        if counts is None:
            into = first + (1 if self.places.get(first) else 0)
        else:
            into = first + 1 if counts == first else first
        damaged = bool(self.places.get(into)) and into not in self.good(first)
        generation = last + (2 if damaged else 1)
        if generation >= 1 << 32:
            return "", 0
        body = little(generation, 4) + payload
        data = body + zlib.crc32(body).to_bytes(4, "little")
        kept = bytearray(data[: int(v.given.get("kept", 512))])
        if "flipped" in v.given:
            kept[v.number("flipped")] ^= 1
        kept += bytes(int(v.given.get("grown", 0)))
        self.places[into] = bytes(kept)
        return f"record={into} saved={data.hex()} ", generation if kept == data else 0


def test_memory_keeps_the_newest_whole_record() -> None:
    memory, usual, seen = Memory(), Settings({}), Counter[str]()
    for v in read(VECTORS / "stores.txt"):
        expected = ""
        if v.word == "settings-usual":
            usual = Settings(v.given)
        elif v.word == "store-blank":
            memory = Memory()
        elif v.word == "store-record":
            memory.places[v.number("record")] = v.bytes("bytes")
        elif v.word == "store-boot":
            damaged = memory.load(2) is None and all(memory.places.get(at) for at in (2, 3))
            text, boots = ("", 0) if damaged else memory.save(2, b"", v)
            expected = text + (f"boots={boots}" if boots else "failed")
        elif v.word == "store-save-settings":
            text, there = memory.save(0, usual.but(v).encoded(True), v)
            expected = text + ("saved" if there else "failed")
        elif v.word == "store-load-settings":
            try:
                expected = decoded(memory.load(0) or b"", True, {})
            except MalformedError:
                expected = "none"
        elif v.word == "store-save-faults":
            count = v.number("count")
            ring = [max(range(i, count + 1, 8), default=0) for i in range(1, 9)]
            entries = [bytes(14) + little(value, 4) + bytes(12) for value in ring]
            text, there = memory.save(4, little(count, 4) + b"".join(entries), v)
            expected = text + ("saved" if there else "failed")
        else:
            data = memory.load(4) or b""
            data = data if len(data) == 244 else bytes(244)
            values = [int.from_bytes(data[18 + 30 * i : 22 + 30 * i], "little") for i in range(8)]
            expected = f"count={int.from_bytes(data[:4], 'little')} values={runs(values)}"
        assert v.answer == expected, v
        seen[f"{v.word} {expected.split(' ')[-1].split('=')[0]}"] += 1
    assert seen["store-boot boots"] > 100 and seen["store-boot failed"] > 20
    assert seen["store-save-settings failed"] == 2 and seen["store-load-settings none"] >= 3


# ---- the clock


@dataclass
class Line:
    """System time by ticks: exact."""

    count: int = 0
    ticks: int = 0
    time: Fraction = Fraction(0)
    rate: Fraction = Fraction(0)

    def passed(self, count: int) -> int:
        return wrapped(count - self.count, 32)

    def at(self, count: int) -> Fraction:
        return self.time + self.passed(count) * (1 + self.rate)

    def advance(self, count: int) -> None:
        self.time = self.at(count)
        self.ticks += self.passed(count)
        self.count = count

    def told(self) -> str:
        fraction = int(self.time % 1 * (1 << 32))
        return f"system_us={self.time // 1} fraction_q32={fraction} ticks_us={self.ticks}"


def test_the_clock_is_an_exact_line() -> None:
    clock, seen = Line(), Counter[str]()
    for v in read(VECTORS / "clocks.txt"):
        seen[v.word] += 1
        if v.word == "clock-rate":
            clock.rate = Fraction(v.number("rate_q32"), 1 << 32)
            continue
        if v.word == "clock":
            offset = Fraction(v.number("offset_q16"), 1 << 16)
            clock = Line(v.number("count_us"), 0, v.number("base_us") + offset)
            expected = clock.told()
        elif v.word == "clock-advance":
            clock.advance(v.number("count_us"))
            expected = clock.told()
        elif v.word == "clock-at":
            count = v.number("count_us")
            expected = (
                f"system_us={clock.at(count) // 1} ticks_us={clock.ticks + clock.passed(count)}"
            )
        else:
            offset = clock.time - clock.ticks - v.number("base_us")
            expected = f"offset_q16={offset * (1 << 16) // 1}"
        assert v.answer == expected, v
    assert min(seen.values()) > 20 and len(seen) == 5


# ---- a board among others


@dataclass
class Given:
    """A feed: a point each so many periods, or where the value changes; the last six are told."""

    steps: int
    value: int
    number: int
    every: int
    after: int
    waits: bool = False
    lag: bool = False
    periods: int = 0
    points: list[tuple[int, int]] = field(default_factory=list)

    def period(self, time: int) -> None:
        due = self.periods % self.every == 0
        self.periods += 1
        if not self.points if self.steps else due:  # no value changes here
            self.points = [*self.points, (time + self.after, self.value)][-6:]
        self.waits |= due

    def body(self, time: int, lineage: int) -> bytes:
        self.waits = False
        head = b"\1\x0f" + little(self.number, 2) + bytes([self.steps, len(self.points)])
        head += little(lineage, 4) + little(time + self.after, 8)
        told = b"".join(little(time + self.after - t, 4) + little(v, 4) for t, v in self.points)
        return head + told.ljust(48, b"\0")


@dataclass
class Asking:
    """What it asks, and what it owes an answer, by ticks that never wrap.

    An answer's interval is widened by what a clock and the reference may have come apart since the
    clock was last judged, or since the question arrived: 800 ppm, up to a second of it.
    """

    given: dict[str, int] = field(default_factory=dict)
    key: bytes = b""
    now: int = 0
    asked: int = 0
    pause: int = 0
    clock: Line = field(default_factory=Line)
    judged: int = 0  # ticks of the last servo period
    known: dict[str, int] = field(default_factory=dict)
    open: dict[int, tuple[int, int]] = field(default_factory=dict)  # by port: nonce, when asked
    owed: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # nonce, arrival, due
    feeds: list["Given"] = field(default_factory=list)
    fed: list[int] = field(default_factory=list)  # their numbers
    fed_last: int = 0  # the feed that was given last
    found: int | None = None  # count of the last period that was given
    heard: int = 0  # up to when all is known that it is fed

    def begin(self, v: Vector) -> None:
        self.key = v.bytes("key")
        self.given = {name: int(value) for name, value in v.given.items() if name != "key"}
        self.now = self.judged = self.given["count_us"]
        self.asked = self.pause = 0
        rate = Fraction(self.given["rate_q32"], 1 << 32)
        self.clock = Line(self.now, 0, Fraction(self.given["base_us"]), rate)
        nothing = {"lineage": 0, "settled": 0, "least_error_ns": -INT32_MAX}
        self.known = nothing | {"most_error_ns": INT32_MAX}
        self.open, self.owed = {}, {}
        self.feeds, self.fed, self.fed_last, self.found = [], [], 0, None
        self.heard = 0

    def rule(self, v: Vector) -> None:
        numbers = v.numbers("values")
        values = dict(zip(numbers[::2], numbers[1::2], strict=True))
        reader = Reader(v.bytes("payload"), 5 + 6 + 1)  # no nodes, no triggers
        self.feeds = []
        for _ in range(reader.take(1)):
            kind, source = reader.take(1), reader.take(1)
            lag = source == 25
            value = INT32_MAX if lag else values[source]
            self.feeds.append(Given(kind, value, *(reader.take(2) for _ in range(3)), lag=lag))
        self.fed = [(reader.take(1), reader.take(2))[1] for _ in range(reader.take(1))]

    def lineage(self) -> int:
        return self.known["lineage"] if self.given.get("among") else 0

    def feed(self) -> bytes | None:
        """The one that is given now."""
        if not self.known["settled"]:
            return None
        time = int(self.clock.time // 1)
        if self.clock.count != self.found:
            self.found = self.clock.count
            for each in self.feeds:
                each.period(time)
                if each.lag:  # of this period, for the next one
                    each.value = max(0, time - self.heard) // 1000
        for _ in self.feeds:
            self.fed_last = (self.fed_last + 1) % len(self.feeds)
            if self.feeds[self.fed_last].waits:
                return self.feeds[self.fed_last].body(time, self.lineage())
        return None

    def ticks(self, v: Vector, name: str = "count_us") -> int:
        """Of a count within half a turn."""
        return self.now + wrapped(v.number(name) - self.now, 32)

    def period(self, v: Vector) -> None:
        self.now = self.judged = self.ticks(v)
        self.clock.advance(v.number("count_us"))
        self.known = {name: v.number(name) for name in self.known}

    def draws(self, v: Vector) -> Iterator[int]:
        random = int(v.given["random"], 16)
        while True:
            yield random
            random = (random + 0x9E3779B97F4A7C15) % (1 << 64)

    def named(self, port: int) -> int:
        return self.given["ports"] >> port & 1

    def speak(self, v: Vector) -> str:
        self.now, draws = self.ticks(v), self.draws(v)
        bodies = list[tuple[int, bytes]]()
        if (self.now - self.asked) % (1 << 32) >= self.pause:
            quarter = self.given["ask_us"] // 4  # to either side, evenly
            self.pause = self.given["ask_us"] - quarter
            self.pause += next(draws) % (1 << 16) * quarter // (1 << 15)
            self.asked = self.now
            for port in filter(self.named, range(1, 5)):
                self.open[port] = next(draws), self.now
                bodies.append((port, b"\1\x0a" + little(self.open[port][0], 8)))
        for port in range(1, 5):
            if port in self.owed and self.owed[port][2] <= self.now:
                bodies.append((port, self.answer(*self.owed.pop(port)[:2])))
        fed = self.feed()
        if fed is not None:
            bodies += [(port, fed) for port in filter(self.named, range(1, 5))]
        packets = [(port, cobs(body + self.tag(body))) for port, body in bodies]
        return " ".join(f"port={port} packet={packet.hex()}" for port, packet in packets)

    def tag(self, body: bytes) -> bytes:
        return little(siphash(self.key, b"\4" + body), 8)

    def answer(self, nonce: int, arrived: int) -> bytes:
        times = self.clock.at(arrived) // 1 + 1, self.clock.at(self.now) // 1
        is_reference = self.given["id"] != 0 and self.known["lineage"] == self.given["id"]
        apart_us = min(self.now - min(arrived, self.judged), 1_000_000)
        blur = 0 if is_reference else 1 + apart_us * 4 // 5
        body = b"\1\x0b" + little(nonce, 8) + b"".join(little(time, 8) for time in times)
        for name, sign in (("least_error_ns", -1), ("most_error_ns", 1)):
            wider = sign * self.known[name] + blur
            body += little(sign * wider if wider < INT32_MAX else self.known[name], 4)
        return body + little(self.known["lineage"], 4) + bytes([self.known["settled"]])

    def take(self, v: Vector) -> str:
        self.now, port, frame = self.ticks(v), v.number("port"), v.bytes("frame")
        body, tag = frame[:-8], frame[-8:]
        if not self.named(port) or tag != self.tag(body):
            return "refused"
        nonce = int.from_bytes(body[2:10], "little")
        if body[:2] == b"\1\x0a" and len(frame) == 18:
            dither_us = self.given["dither_us"]
            wait_us = next(self.draws(v)) % dither_us if dither_us else 0
            self.owed[port] = nonce, self.ticks(v, "arrived_us"), self.now + wait_us
            return "taken"
        if body[:2] == b"\1\x0f" and len(frame) == 74:
            number, count, lineage = (
                body[2] + 256 * body[3],
                body[5],
                int.from_bytes(body[6:10], "little"),
            )
            off_us = abs(int(self.clock.at(self.now) // 1) - Reader(body, 10).time())
            good = count > 0 and self.known["settled"] and lineage == self.lineage()
            good &= number not in self.fed or off_us <= 100_000
            if good and number in self.fed:
                self.heard = max(self.heard, Reader(body, 10).time())
            return "taken" if good else "refused"
        if body[:2] != b"\1\x0b" or len(frame) != 47 or self.open.get(port, (-1, 0))[0] != nonce:
            return "refused"
        reader, asked = Reader(body, 10), self.open.pop(port)[1]
        received, sent = reader.time(), reader.time()
        least, most, lineage = reader.take(4, True), reader.take(4, True), reader.take(4)
        delay = self.given["peer_least_us"]
        return (
            f"source={port} to_here_least_us={delay} to_there_least_us={delay} "
            f"least_error_ns={least} most_error_ns={most} lineage={lineage} "
            f"settled={reader.take(1) % 2} echo_us={asked % (1 << 32)} received_us={received} "
            f"sent_us={sent} arrived_us={v.number('arrived_us')} "
            f"count_us={v.number('count_us')} taken"
        )


def test_neighbours_are_asked_at_random_and_answered_once() -> None:
    board, seen = Asking(), Counter[str]()
    for v in read(VECTORS / "neighbours.txt"):
        if v.word == "neighbours":
            board.begin(v)
        elif v.word == "neighbours-period":
            board.period(v)
        elif v.word == "neighbours-flush":
            board.owed = {}
        elif v.word == "neighbours-logic":
            board.rule(v)
        else:
            expected = board.speak(v) if v.word == "neighbours-speak" else board.take(v)
            assert v.answer == expected, v
            seen[expected.partition("=")[0] if "=" in expected else expected or "silent"] += 1
            seen["answer"] += "010b" in expected and v.word == "neighbours-speak"
            seen["feed"] += "010f" in expected and v.word == "neighbours-speak"
    kinds = ("port", "source", "taken", "silent", "answer", "feed")
    assert min(seen[kind] for kind in kinds) > 10
    assert seen["refused"] > 50


Proof = tuple[Fraction, int]  # of an offset, at ticks


@dataclass
class Knowledge:
    """What proofs leave, in exact numbers: every proof is kept, and every pair of them looked at.

    A proof of age a bounds the offset now by its value + k a +- wander a^2 / 2, where k is the skew
    now. A lower and an upper one so bound the skew. What was known of both is carried on.
    """

    drift: Fraction
    wander: Fraction
    ticks: int
    lower: list[Proof] = field(default_factory=list)
    upper: list[Proof] = field(default_factory=list)
    low: Fraction | None = None
    high: Fraction | None = None
    slowest: Fraction = Fraction(0)
    fastest: Fraction = Fraction(0)

    def __post_init__(self) -> None:
        self.slowest, self.fastest = -self.drift, self.drift

    def advance(self, ticks: int) -> None:
        passed = ticks - self.ticks
        if passed <= 0:
            return
        self.ticks = ticks
        self.slowest = max(-self.drift, self.slowest - passed * self.wander)
        self.fastest = min(self.drift, self.fastest + passed * self.wander)
        if self.low is not None:
            self.low += passed * self.slowest
        if self.high is not None:
            self.high += passed * self.fastest

    def at(self, ticks: int) -> tuple[Fraction, Fraction]:
        """Both bounds some milliseconds before or after: the skew there was, or may be, other."""
        passed = ticks - self.ticks
        assert self.low is not None and self.high is not None
        wandered = self.wander * passed * passed / 2
        ways = self.slowest * passed, self.fastest * passed
        return self.low + min(ways) - wandered, self.high + max(ways) + wandered

    def width(self) -> Fraction:
        assert self.low is not None and self.high is not None
        return self.high - self.low

    def _now(self, proof: Proof, skew: Fraction, sign: int) -> Fraction:
        age = self.ticks - proof[1]
        return proof[0] + skew * age + sign * self.wander * age * age / 2

    def _fresh(self, proofs: list[Proof]) -> list[Proof]:
        return [p for p in proofs if self.ticks - p[1] <= 1 << 25]

    def prove(self, is_upper: bool, value: Fraction, ticks: int) -> Fraction:
        """Takes a proof if something is left; else returns by how much there is too little."""
        new = value, ticks
        if not 0 <= self.ticks - ticks <= 1 << 25:
            return Fraction(0)
        slowest, fastest = self.slowest, self.fastest
        missing = Fraction(0)
        for other in self._fresh(self.lower if is_upper else self.upper):
            low, high = (other, new) if is_upper else (new, other)
            room = self._now(high, Fraction(0), 1) - self._now(low, Fraction(0), -1)
            longer = high[1] - low[1]  # by so much is the lower one older
            if longer > 0:
                fastest = min(fastest, room / longer)
            elif longer < 0:
                slowest = max(slowest, room / longer)
            elif room < 0:
                missing = max(missing, -room)
        if slowest > fastest:
            return max(missing, (slowest - fastest) * (1 << 20))
        lower = self._fresh(self.lower) + [new] * (not is_upper)
        upper = self._fresh(self.upper) + [new] * is_upper
        lows = [self._now(p, slowest, -1) for p in lower] + [self.low] * (self.low is not None)
        highs = [self._now(p, fastest, 1) for p in upper] + [self.high] * (self.high is not None)
        low, high = (
            (max(x for x in lows if x is not None) if lows else None),
            (min(x for x in highs if x is not None) if highs else None),
        )
        if low is not None and high is not None and low > high:
            return max(missing, low - high)
        if missing:
            return missing
        self.lower, self.upper, self.low, self.high = lower, upper, low, high
        self.slowest, self.fastest = slowest, fastest
        return Fraction(0)


def numbers_of(answer: str) -> dict[str, int]:
    return {n: int(x) for n, _, x in (part.partition("=") for part in answer.split(" ")) if x}


Q16, Q32 = Fraction(1, 1 << 16), Fraction(1, 1 << 32)
NEARLY = Fraction(1, 10)  # us: what is refused by less may be taken, by rounding


def test_bounds_are_what_the_proofs_leave() -> None:
    """Never narrower, and hardly wider though only twelve lines a side are kept."""
    known, seen, ratios = Knowledge(Fraction(0), Fraction(0), 0), Counter[str](), []
    last: dict[str, int] = {}
    lasting = 0  # the longest advance
    for v in read(VECTORS / "bounds.txt"):
        if v.word == "bounds-clear":
            drift = v.number("drift_q32") * Q32
            known = Knowledge(drift, v.number("wander_q64") * Q32 * Q32, v.number("ticks_us"))
            lasting = 0
            continue
        got = numbers_of(v.answer)
        if v.word == "bounds-at":
            low, high = known.at(v.number("ticks_us"))
            assert got["lower_q16"] * Q16 <= low and high <= got["upper_q16"] * Q16, v
            margin = got["upper_q16"] - got["lower_q16"] - (last["upper_q16"] - last["lower_q16"])
            assert margin * Q16 <= high - low - (known.width() - Fraction(1, 10)), v
            seen[v.word] += 1
            continue
        if v.word == "bounds-nearest":
            middle_q16 = (last["lower_q16"] + last["upper_q16"]) // 2
            least, most = last["least_skew_q32"], last["most_skew_q32"]
            nearest = sorted((least, v.number("skew_q32"), most))[1]
            expected = f"middle_q16={middle_q16} skew_q32={(least + most) // 2}"
            assert v.answer == f"{expected} nearest_q32={nearest}", v
            seen[v.word] += nearest == v.number("skew_q32")
            continue
        last = got
        if v.word == "bounds-advance":
            lasting = max(lasting, v.number("ticks_us") - known.ticks)
            known.advance(v.number("ticks_us"))
        else:
            is_upper = "at_most_q16" in v.given
            value = v.number("at_most_q16" if is_upper else "at_least_q16") * Q16
            missing = known.prove(is_upper, value, v.number("ticks_us"))
            verdict = v.answer.split(" ")[0]
            assert verdict in ("taken", "refused")
            assert (missing > 0) >= (verdict == "refused"), v
            assert verdict == "refused" or missing < NEARLY, v
            seen[verdict] += 1
        assert got["least_skew_q32"] * Q32 <= known.slowest, v
        assert got["most_skew_q32"] * Q32 >= known.fastest, v
        assert ("lower_q16" in got) == (known.low is not None)
        assert ("upper_q16" in got) == (known.high is not None)
        if known.low is not None:
            assert got["lower_q16"] * Q16 <= known.low, v
        if known.high is not None:
            assert got["upper_q16"] * Q16 >= known.high, v
        # After more than an hour without a look the skew may be anything.
        if known.low is not None and known.high is not None and lasting < 1 << 32:
            width = (got["upper_q16"] - got["lower_q16"]) * Q16
            ratios.append(float((width + 1) / (known.high - known.low + 1)))
    assert seen["taken"] > 300 and seen["refused"] > 40
    assert seen["bounds-at"] > 50 and seen["bounds-nearest"] > 9
    assert sorted(ratios)[len(ratios) // 2] < 1.05
    assert max(ratios) < 2


def test_average_is_the_mean_times_its_gains() -> None:
    offsets: list[tuple[int, int]] = []
    began, skew, rates = 0, 0, 0
    for v in read(VECTORS / "averages.txt"):
        if v.word == "average":
            offsets, began, skew = [], v.number("ticks_us"), 0
            continue
        if v.word == "average-take":
            most = 1 << 30
            offset = sorted((-most, v.number("offset_us"), most))[1]
            for _ in range(int(v.given.get("times", 1))):
                if sum(times for _, times in offsets) == 1 << 20:  # older ones weigh half
                    total = toward_zero(sum(o * times for o, times in offsets), 2)
                    offsets = [(total, 1), (0, (1 << 19) - 1)]
                if offsets and offsets[-1][0] == offset:
                    offsets[-1] = offset, offsets[-1][1] + 1
                else:
                    offsets.append((offset, 1))
            continue
        if v.number("ticks_us") - began < v.number("interval_us") or not offsets:
            assert v.answer == "none", v
            continue
        count = sum(times for _, times in offsets)
        mean = toward_zero(sum(o * times for o, times in offsets), count)
        mean = sorted((-(1 << 14), mean, 1 << 14))[1]
        drift = v.number("drift_q32")
        skew = sorted((-drift, skew + (mean * v.number("skew_gain_q8") >> 8), drift))[1]
        rate = sorted((-2_147_484, skew + mean * v.number("phase_gain"), 2_147_484))[1]
        assert v.answer == f"rate_q32={rate}", v
        offsets, began = [], v.number("ticks_us")
        rates += 1
    assert rates > 50


@dataclass
class Board:
    """A clock that is synchronized, by what sync.h and lineage.h say of it."""

    given: dict[str, int]
    clock: Line
    known: Knowledge | None = None
    base: int = 0
    excluded: int = 0
    outcast: int = 0
    wide: int = 0
    stepped: bool = False
    settled: bool = False
    whose: int = 0
    skew: Fraction | None = None  # as steering has found it
    steered: int = 0
    mark: tuple[Fraction, int] | None = None
    doubts: Counter[int] = field(default_factory=Counter)  # by source: those that were heard
    doubtful: bool = False

    def ticks(self, count: int) -> int:
        return self.clock.ticks + self.clock.passed(count)

    @property
    def is_reference(self) -> bool:
        return self.given["id"] != 0 and self.whose == self.given["id"] and self.known is not None

    def begin(self, whose: int, base: int) -> None:
        limits = self.given["drift_ppm"] * 4295, self.given["wander_ppb_s"] * 18_447
        self.known = Knowledge(limits[0] * Q32, limits[1] * Q32 * Q32, self.clock.ticks)
        self.base, self.whose, self.wide = base, whose, self.clock.ticks
        self.settled, self.mark, self.skew, self.outcast = False, None, None, 0
        self.doubts, self.doubtful = Counter(), False

    def joins(self, other: int, settled: bool, ahead: tuple[Fraction, Fraction]) -> bool:
        """Settled ones are joined, by those that are not; else the older, else the higher."""
        if not self.given["among_boards"] or other in (0, self.whose):
            return False
        if settled or self.settled:
            return settled and not self.settled
        older, younger = ahead[0] > 0, ahead[1] < 0
        return older or (not younger and other > self.whose)

    def take(self, v: Vector) -> str:
        """Stamps of the host, or of a neighbour that knows its own error."""
        arrived, echo, now = (
            self.ticks(v.number(name)) for name in ("arrived_us", "echo_us", "count_us")
        )
        sent, received = v.number("sent_us"), v.number("received_us")
        least, whose, settled = Fraction(0), 0, False
        most, here, there = least, self.given["to_device_least_us"], self.given["to_host_least_us"]
        if v.word == "sync-hear":
            here = there = v.number("peer_least_us")
            if abs(v.number("least_error_ns")) == INT32_MAX == abs(v.number("most_error_ns")):
                return self.told("ignored")
            if v.number("least_error_ns") == -INT32_MAX or v.number("most_error_ns") == INT32_MAX:
                return self.told("ignored")
            least = Fraction(v.number("least_error_ns"), 1000)
            most = Fraction(v.number("most_error_ns"), 1000)
            whose, settled = v.number("lineage"), v.number("settled") == 1
        if v.number("may_step"):
            times = [self.clock.at(v.number(name)) // 1 for name in ("arrived_us", "echo_us")]
            ahead = Fraction(sent - times[0] - 1 + here), Fraction(received - times[1] + 1 - there)
            if self.known is None or self.joins(whose, settled, ahead):
                self.begin(whose, sent - arrived)
                self.stepped = True
                self.clock.time = Fraction(self.clock.ticks + self.base)
        if self.known is None or self.is_reference:
            return self.told("ignored")
        self.known.advance(now)
        low = sent - arrived - self.base - 1 + here
        high = received - echo - self.base + 1 - there
        echoes = received != 0 and echo <= arrived
        far = abs(low) > 1 << 44 or (echoes and abs(high) > 1 << 44)
        other = self.given["among_boards"] and whose != self.whose
        missing = Fraction(int(far or other))
        if not missing:
            upper = (high - least, echo) if echoes else None
            missing = self.prove((low - most, arrived), upper)
        assert not missing or missing > NEARLY, v  # the generator keeps off the edge
        self.excluded += missing > 0
        self.outcast = self.outcast + 1 if missing else 0
        source = int(v.given.get("source", 0))
        doubt = self.doubts[source]
        if missing:  # sixteen are enough, if none between them is taken
            self.doubts[source] = doubt if doubt > 1024 else doubt + 64
        else:
            self.doubts[source] = max(0, doubt - 1)
        return self.told("excluded" if missing else "taken")

    def prove(self, lower: Proof, upper: Proof | None) -> Fraction:
        """Both proofs, or none."""
        assert self.known is not None
        before = copy(self.known)
        missing = self.known.prove(False, *lower)
        if not missing and upper:
            missing = self.known.prove(True, *upper)
        if missing:
            self.known = before
        return missing

    def told(self, word: str) -> str:
        counted = f"excluded={self.excluded} outcast={self.outcast}"
        return f"{word} {counted} lineage={self.whose}"

    def date(self, v: Vector) -> str:
        """When a mark was: in whole microseconds, all that is possible, and hardly more."""
        got = numbers_of(v.answer)
        assert got["mark_number"] == v.number("mark_number")
        if self.known is None or self.known.low is None or self.known.high is None:
            assert (got["mark_width_us"], got["mark_least_us"]) == (0xFFFF, 0), v
            return "open"
        ticks = self.ticks(v.number("at_us"))
        low, high = (self.base + ticks + bound for bound in self.known.at(ticks))
        far = abs(ticks - self.known.ticks) > 1_000_000
        if far or got["mark_width_us"] == 0xFFFF:  # it knows too little
            assert got["mark_width_us"] == 0xFFFF and got["mark_least_us"] == 0, v
            assert far or high - low > 0xFFFF - 5, v
            return "open"
        least, most = got["mark_least_us"], got["mark_least_us"] + got["mark_width_us"]
        assert least <= low and high + 1 <= most, v
        assert got["mark_width_us"] < (high - low) * Fraction(6, 5) + 5, v
        return "dated"

    def agree(self, v: Vector) -> str:
        """What all boards know of a mark: two proofs, and where the clock is steered to."""
        assert self.known is not None
        ticks = self.ticks(v.number("at_us"))
        self.known.advance(self.ticks(v.number("count_us")))
        low = v.number("mark_least_us") - 1 - self.base - ticks
        high = low + 1 + v.number("mark_width_us")
        missing = Fraction(int(abs(low) > 1 << 44))
        if not missing:
            missing = self.prove((Fraction(low), ticks), (Fraction(high), ticks))
        assert not missing or missing > NEARLY, v
        if missing:
            self.excluded += 1
        else:
            self.mark = Fraction(low + high, 2), ticks
        word = "excluded" if missing else "taken"
        assert v.answer == f"{word} excluded={self.excluded} outcast={self.outcast}", v
        return f"mark {word}"

    def steer(self, v: Vector) -> None:
        """The map to the last bit; what is told never less than is known, and of that clock."""
        got, clock = numbers_of(v.answer), self.clock
        clock.advance(v.number("count_us"))
        time = got["system_us"] + Fraction(got["fraction_q32"], 1 << 32)
        assert got["ticks_us"] == clock.ticks, v
        if self.known is None and self.given["among_boards"] and v.number("may_step"):
            self.begin(self.given["id"], clock.time // 1 - clock.ticks)
        assert got["lineage"] == self.whose, v
        unknown = INT32_MAX
        least, most = got["least_error_ns"], got["most_error_ns"]
        if self.is_reference:
            assert (least, most, got["rate_q32"], got["stepped"]) == (0, 0, 0, self.stepped), v
            self.stepped = False
            assert time == clock.time, v
            self.settle(v, got["settled"], 0)
            clock.rate = Fraction(0)
            return
        if self.known is None or self.known.low is None or self.known.high is None:
            assert (least, most) == (-unknown, unknown), v
            assert got["stepped"] == self.stepped and time == clock.time, v
            assert not got["settled"]
            self.wide, self.stepped, self.settled = clock.ticks, False, False
            return
        self.known.advance(clock.ticks)
        if not v.number("may_step"):
            assert time == clock.time, v
        jump = time - clock.time
        assert got["stepped"] == (self.stepped or jump != 0), v
        self.doubtful |= min(self.doubts.values(), default=0) >= 1024
        if self.doubtful:  # nothing is known until a restart, and no skew can be told
            assert (least, most, got["settled"]) == (-unknown, unknown, 0), v
            clock.time, clock.rate, self.skew = time, got["rate_q32"] * Q32, None
            self.wide, self.stepped, self.settled = clock.ticks, False, False
            return
        ahead = Fraction(least + most, 2000)  # us that the clock is ahead of where it should be
        offset = time - clock.ticks - self.base
        near = Fraction(1, 500)
        if -least == unknown or most == unknown:  # by more than can be told
            near = NEARLY
            ahead = offset - (self.known.low + self.known.high) / 2
        if self.mark and clock.ticks - self.mark[1] <= 200_000:
            assert self.skew is not None
            middle = self.mark[0] + self.skew * (clock.ticks - self.mark[1])
            told = offset - Fraction(most, 1000), offset - Fraction(least, 1000)
            ahead = offset - sorted((told[0], middle, told[1]))[1]
        if jump:
            assert abs(ahead) < near and abs(jump) > 8 - NEARLY, v
        elif v.number("may_step"):
            assert abs(ahead) < 8 + NEARLY, v
        clock.time, self.stepped = time, False
        assert least <= max(-unknown, (offset - self.known.high) * 1000), v
        assert most >= min(unknown, (offset - self.known.low) * 1000), v
        self.assert_rate(v, got["rate_q32"], ahead)
        error = max(-least, most)
        self.settle(v, got["settled"], unknown if error == unknown else error // 1000 + 1)
        clock.rate = got["rate_q32"] * Q32

    def settle(self, v: Vector, settled: int, error_us: int) -> None:
        if error_us > self.given["limit_us"]:
            self.wide = self.clock.ticks
        assert settled == (self.clock.ticks - self.wide >= 1_000_000), v
        self.settled = settled == 1

    def assert_rate(self, v: Vector, rate_q32: int, ahead: Fraction) -> None:
        """The skew, and what fades the offset in 2^14 us, or one from a mark in 2^17, at 300 ppm
        at most.

        The skew is at first the middle of what is possible, later an integral's, within that.
        """
        assert self.known is not None
        ticks, top = self.clock.ticks, Fraction(300, 10**6)
        assert abs(rate_q32) <= 2_147_484, v
        if self.given["method"] == 1 and self.settled:
            self.skew = self.skew or Fraction(0)
            return
        slowest, fastest = self.known.slowest, self.known.fastest
        marked = self.mark is not None and ticks - self.mark[1] <= 200_000
        fade = sorted((-top, -ahead / (1 << (17 if marked else 14)), top))[1]
        skew, near = rate_q32 * Q32 - fade, (fastest - slowest) / 4 + Fraction(2, 10**6)
        if not self.settled:
            expected = (slowest + fastest) / 2
        else:
            assert self.skew is not None
            early = marked or ticks - self.wide < 8_000_000
            expected = self.skew
            if abs(fade) < top:
                expected += fade * (ticks - self.steered) / (1 << (20 if early else 22))
            if slowest <= expected <= fastest:
                near = Fraction(15 if self.mark else 6, 10**7)  # of told nanoseconds, by 2^14 us
            expected = sorted((slowest, expected, fastest))[1]
        assert abs(skew - expected) <= near or abs(rate_q32) == 2_147_484, v
        # Where a mark is carried on by it, an error of what is told would grow from row to row.
        sure = self.mark is not None or near < Fraction(1, 10**6) or abs(rate_q32) == 2_147_484
        self.skew = expected if sure else skew
        self.steered = ticks


def test_clocks_are_steered_by_their_definition() -> None:
    board, seen, widths = Board({}, Line()), Counter[str](), []
    for v in read(VECTORS / "steering.txt"):
        if v.word == "sync":
            given = {name: int(x) for name, x in v.given.items()}
            board = Board(given, Line(v.number("count_us")))
        elif v.word == "sync-date":
            seen[board.date(v)] += 1
        elif v.word == "sync-mark":
            if board.known is None:
                assert v.answer == "excluded excluded=0 outcast=0"
            else:
                seen[board.agree(v)] += 1
        elif v.word in ("sync-take", "sync-hear"):
            expected = board.take(v)
            assert v.answer == expected, v
            seen[expected.split(" ")[0]] += 1
        else:
            board.steer(v)
            got, known = numbers_of(v.answer), board.known
            seen["settled"] += got["settled"]
            seen["stepped"] += got["stepped"]
            seen["doubtful"] += board.doubtful
            if board.doubtful:
                continue
            if known and known.low is not None and known.high is not None:
                width = Fraction(got["most_error_ns"] - got["least_error_ns"], 1000)
                widths.append(float((width + 1) / (known.high - known.low + 1)))
    assert seen["taken"] > 400 and seen["excluded"] > 50, seen
    assert seen["settled"] > 100 and seen["stepped"] > 30 and seen["ignored"] > 50, seen
    assert seen["dated"] > 30 and seen["open"] > 0, seen
    assert seen["doubtful"] > 9, seen
    assert seen["mark taken"] > 30 and seen["mark excluded"] > 30, seen
    assert sorted(widths)[len(widths) // 2] < 1.05
