"""A second opinion on the vectors of signals: fractions, plain Python, payloads byte by byte."""

from bisect import bisect_right
from fractions import Fraction

from test_vectors import INT32_MAX, TIME_MAX, VECTORS, Vector, read

PIECES, READINGS, NODES, TRIGGERS, BATCH, REPORTED = 32, 128, 16, 4, 64, 48
PATIENCE = 4
LONGEST_US = 1 << 30
NODE, PAST, FEEDS = 32, 6, 4


def wrapped(value: int, bits: int = 32) -> int:
    return (value + (1 << bits - 1)) % (1 << bits) - (1 << bits - 1)


def optional(v: Vector, name: str) -> int | None:
    return v.number(name) if name in v.given else None


class Track:
    """All pieces that were taken: start, end, from, to."""

    def __init__(self, after: int = 0) -> None:
        """`after`: so many events at time 0."""
        self.before = max(after - 1, 0)  # that nobody remembers
        still: list[tuple[int, int, Fraction, int]] = [(0, 0, Fraction(0), 0)]
        self.lines = still if after else []

    @property
    def count(self) -> int:
        return self.before + len(self.lines)

    def at(self, time_us: int) -> Fraction:
        kept = self.lines[-PIECES:]
        i = bisect_right([line[0] for line in kept], time_us) - 1
        if i < 0:
            return Fraction(0)
        start, end, first, last = kept[i]
        return (
            Fraction(last)
            if time_us >= end
            else first + (last - first) * Fraction(time_us - start, end - start)
        )

    def reaches(self, time_us: int) -> bool:
        return any(line[0] <= time_us for line in self.lines[-PIECES:])

    def take(self, v: Vector) -> str:
        number, now_us = v.number("number"), v.number("now_us")
        start, first = optional(v, "start_us"), optional(v, "from")
        if number < self.count:
            return "taken"
        if number > self.count or (not self.lines and None in (start, first)):
            return "gap"
        start_us = self.lines[-1][1] if start is None else start
        end_us = v.number("end_us")
        before = self.lines[-1][0] if self.lines else start_us
        if not 0 <= end_us - start_us <= LONGEST_US or start_us < before:
            return "order"
        if self.count > 1 << 31:
            return "full"
        if len(self.lines) >= PIECES and self.lines[-PIECES + 1][0] > now_us:
            return "full"
        value = Fraction(first) if first is not None else Fraction(round(self.at(start_us)))
        self.lines.append((start_us, end_us, value, v.number("to")))
        return "late" if start_us < now_us else "taken"


def test_pieces() -> None:
    track, results, gone = Track(), set(), 0
    for v in read(VECTORS / "pieces.txt"):
        if v.word == "pieces":
            track = Track()
        elif v.word == "pieces-after":
            track = Track(v.number("count"))
        elif v.word == "piece-take":
            result = track.take(v)
            assert v.answer == f"{result} next={track.count}", v
            results.add(result)
        elif v.word == "piece-past" and not track.reaches(v.number("time_us")):
            assert v.answer == "gone", v
            gone += 1
        else:
            value = int(v.answer.partition("=")[2])
            assert abs(value - track.at(v.number("time_us"))) < 2, v
    assert results == {"taken", "gap", "late", "order", "full"} and gone > 50


def exists(source: int, nodes: int) -> bool:
    return source < 26 or NODE <= source < NODE + nodes


def wrong_node(node: list[int], at: int, nodes: int, shift: int = 12) -> str:
    kind, a, b, low, high = node
    if kind > PAST:
        return "kind"
    if kind == PAST and a > 15:
        return "missing"
    if kind == PAST:
        return "limits" if low < 0 or (a < 5 and low > 254 << shift) else ""
    if low > high:
        return "limits"
    for source in (a, b) if kind in (0, 1, 4) else (a,):
        if not exists(source, nodes):
            return "missing"
        if source >= NODE + at:
            return "cycle"
    return ""


def fives(numbers: list[int]) -> list[list[int]]:
    return [numbers[i : i + 5] for i in range(0, len(numbers), 5)]


def first_wrong(nodes: list[list[int]], shift: int = 12) -> tuple[str, int]:
    for at, node in enumerate(nodes):
        if found := wrong_node(node, at, len(nodes), shift):
            return found, at
    return "good", len(nodes)


def step(nodes: list[list[int]], held: list[bool], values: list[int], past: list[int]) -> list[int]:
    known = dict(enumerate(values))

    def clip(value: int) -> int:
        return max(-INT32_MAX, min(INT32_MAX, value))

    found = []
    for i, (kind, source_a, source_b, low, high) in enumerate(nodes):
        a, b = known.get(source_a, 0), known.get(source_b, 0)
        value = [
            lambda a, b, *_: clip(a + b),
            lambda a, b, *_: clip(a * b >> 16),
            lambda a, b, low, high, on: int(a > high or (on and a >= low)),
            lambda a, b, low, high, on: int(low <= a <= high),
            lambda a, b, *_: a if b else 0,
            lambda a, b, low, high, on: int(a != 0 and not on),
            lambda *_, i=i: past[i],
        ][kind](a, b, low, high, held[i])
        held[i] = a != 0 if kind == 5 else value != 0
        known[NODE + i] = value
        found.append(value)
    return found


def test_graphs() -> None:
    nodes: list[list[int]] = []
    held: list[bool] = []
    results = set()
    for v in read(VECTORS / "graphs.txt"):
        if v.word == "graph":
            nodes = fives(v.numbers("nodes"))
            result, at = first_wrong(nodes, optional(v, "knot_shift") or 12)
            assert v.answer == f"{result} wrong={at}", v
            results.add(result)
            nodes = nodes if result == "good" else []
            held = [False] * len(nodes)
        else:
            past = v.numbers("past") if "past" in v.given else []
            got = Vector(0, "", {"nodes": v.answer.partition("=")[2]}, "").numbers("nodes")
            assert got == step(nodes, held, v.numbers("values"), past), v
    assert results == {"good", "kind", "missing", "cycle", "limits"}


def test_readings() -> None:
    kept: list[tuple[int, int, int]] = []
    first = told = tellings = overwritten = again = 0
    for v in read(VECTORS / "readings.txt"):
        if v.word == "readings":
            kept, first, tellings = [], v.number("taken"), 0
            told = first
            continue
        if v.word == "readings-tell":
            left, ahead = len(kept), (told - first) % (1 << 32)  # of those that were told
            tellings += 0 < ahead <= left
            if ahead > left or tellings > PATIENCE:  # overwritten before, or without an answer
                again += ahead <= left
                ahead = tellings = 0
            count = min(left - ahead, v.number("most"))
            assert v.answer == f"first={(first + ahead) % (1 << 32)} count={count}", v
            told = (first + ahead + count) % (1 << 32)
            continue
        if v.word == "readings-push":
            for i in range(v.number("times")):
                kept.append((v.number("time_us") + i, v.number("value") + i, v.number("trigger")))
        else:
            count = (v.number("number") - first) % (1 << 32)
            if 0 < count <= len(kept):
                tellings = 0
                kept, first = kept[count:], (first + count) % (1 << 32)
        gone = max(0, len(kept) - READINGS)
        kept, first = kept[gone:], (first + gone) % (1 << 32)
        overwritten += gone
        got = dict(part.split("=") for part in v.answer.split())
        assert int(got["kept"]) == first, v
        assert int(got["taken"]) == (first + len(kept)) % (1 << 32), v
        if kept:
            assert int(got["first_us"]) == kept[0][0], v
            last = int(got["last_us"]), int(got["value"]), int(got["trigger"])
            assert last == kept[-1], v
    assert overwritten > 4 and again > 4


# ---- payloads


class Reader:
    def __init__(self, payload: bytes) -> None:
        self.left = payload

    def number(self, size: int, signed: bool = False) -> int:
        if len(self.left) < size:
            raise ValueError
        word, self.left = self.left[:size], self.left[size:]
        return int.from_bytes(word, "little", signed=signed)

    def varint(self) -> int:
        word = 0
        for shift in range(0, 64, 7):
            byte = self.number(1)
            word |= (byte & 0x7F) << shift
            if byte < 0x80:
                word %= 1 << 64
                return wrapped((word >> 1) ^ -(word & 1), 64)
        raise ValueError

    def end(self) -> None:
        if self.left:
            raise ValueError


def zigzag(value: int) -> bytes:
    word, out = (value << 1) ^ (value >> 63), b""
    while word >= 0x80:
        out, word = out + bytes([word & 0x7F | 0x80]), word >> 7
    return out + bytes([word])


def check(good: bool) -> None:
    if not good:
        raise ValueError


def read_batch(payload: bytes) -> str:
    r = Reader(payload)
    base = r.number(8, signed=True)
    check(abs(base) <= TIME_MAX)
    said = f"base_us={base} seen={r.number(4)}"
    count = r.number(1)
    check(count <= BATCH)
    for _ in range(count):
        track, number, flags = r.number(1), r.number(4), r.number(1)
        check(5 <= track < 16 and flags <= 3)
        start = first = None
        if flags & 1:
            start = r.varint()
            check(abs(start) <= TIME_MAX)
        end = r.varint()
        check(abs(end) <= TIME_MAX)
        if flags & 2:
            first = r.varint()
            check(-INT32_MAX - 1 <= first <= INT32_MAX)
        last = r.varint()
        check(-INT32_MAX - 1 <= last <= INT32_MAX)
        said += f" track={track} number={number} flags={flags}"
        said += f" start_us={0 if start is None else base + start} end_us={base + end}"
        said += f" from={first or 0} to={last}"
    r.end()
    return said


def write_batch(head: Vector, pieces: list[Vector], count: int) -> bytes | None:
    base = head.number("base_us")
    if abs(base) > TIME_MAX or count > BATCH:
        return None
    out = (base % (1 << 64)).to_bytes(8, "little") + head.number("seen").to_bytes(4, "little")
    out += bytes([count])
    for v in pieces:
        start, first = optional(v, "start_us"), optional(v, "from")
        end = v.number("end_us")
        near = all(abs(t - base) <= TIME_MAX for t in (start, end) if t is not None)
        if not (near and 5 <= v.number("track") < 16):
            return None
        flags = (start is not None) + 2 * (first is not None)
        out += bytes([v.number("track")]) + v.number("number").to_bytes(4, "little")
        out += bytes([flags])
        out += zigzag(start - base) if start is not None else b""
        out += zigzag(end - base)
        out += zigzag(first) if first is not None else b""
        out += zigzag(v.number("to"))
    return out


def test_batches() -> None:
    pieces: list[Vector] = []
    counts = {"refused": 0, "malformed": 0, "good": 0}
    for v in read(VECTORS / "batches.txt"):
        if v.word == "batch":
            head, pieces = v, []
        elif v.word == "batch-piece":
            pieces.append(v)
        elif v.word == "batch-encode":
            made = write_batch(head, pieces, optional(v, "count") or len(pieces))
            if made is None or len(made) > v.number("capacity"):
                assert v.answer == "refused", v
                counts["refused"] += 1
            else:
                assert v.answer == f"payload={made.hex()}", v
        else:
            try:
                said = read_batch(v.bytes("payload"))
                counts["good"] += 1
            except ValueError:
                said = "malformed"
                counts["malformed"] += 1
            assert v.answer == said, v
    assert min(counts.values()) > 10


def check_logic(v: Vector) -> tuple[str, int]:
    nodes = fives(v.numbers("nodes"))
    result, at = first_wrong(nodes)
    if result != "good":
        return result, at
    for source in v.numbers("digital") + v.numbers("pwm"):
        if source != 255 and not exists(source, len(nodes)):
            return "missing", at
        at += 1
    numbers = v.numbers("triggers")
    for kind, source, condition, every in zip(*(numbers[i::4] for i in range(4)), strict=True):
        if kind > 2:
            return "kind", at
        if not exists(source, len(nodes)) or (kind != 0 and not exists(condition, len(nodes))):
            return "missing", at
        if kind != 1 and every == 0:
            return "limits", at
        at += 1
    return check_feeds(v, at, len(nodes))


def check_feeds(v: Vector, at: int, nodes: int) -> tuple[str, int]:
    feeds, fed = (v.numbers(name) if name in v.given else [] for name in ("feeds", "fed"))
    own: list[int] = []
    for kind, source, number, every, _ in fives(feeds):
        if kind > 1:
            return "kind", at
        if not exists(source, nodes):
            return "missing", at
        if number in own or every == 0:
            return "limits", at
        own.append(number)
        at += 1
    tracks: list[int] = []
    for track, number in zip(fed[::2], fed[1::2], strict=True):
        if not 5 <= track < 16:
            return "missing", at
        if track in tracks:
            return "limits", at
        if number in own:
            return "cycle", at
        tracks.append(track)
        at += 1
    return "good", at


def write_logic(v: Vector) -> bytes:
    nodes, triggers = fives(v.numbers("nodes")), v.numbers("triggers")
    out = v.number("number").to_bytes(4, "little") + bytes([len(nodes)])
    for kind, a, b, low, high in nodes:
        out += bytes([kind, a, b])
        out += b"".join((n % (1 << 32)).to_bytes(4, "little") for n in (low, high))
    out += bytes(v.numbers("digital")) + bytes(v.numbers("pwm")) + bytes([len(triggers) // 4])
    for i in range(0, len(triggers), 4):
        out += bytes(triggers[i : i + 3]) + triggers[i + 3].to_bytes(2, "little")
    feeds, fed = (v.numbers(name) if name in v.given else [] for name in ("feeds", "fed"))
    out += bytes([len(feeds) // 5])
    for kind, source, *rest in fives(feeds):
        out += bytes([kind, source]) + b"".join(n.to_bytes(2, "little") for n in rest)
    out += bytes([len(fed) // 2])
    for track, number in zip(fed[::2], fed[1::2], strict=True):
        out += bytes([track]) + number.to_bytes(2, "little")
    return out


def read_logic(payload: bytes) -> str:
    r = Reader(payload)
    r.number(4)
    nodes = r.number(1)
    check(nodes <= NODES)
    r.number(11 * nodes + 6)
    triggers = r.number(1)
    check(triggers <= TRIGGERS)
    r.number(5 * triggers)
    feeds = r.number(1)
    check(feeds <= FEEDS)
    r.number(8 * feeds)
    fed = r.number(1)
    check(fed <= FEEDS)
    r.number(3 * fed)
    r.end()
    counts = f"nodes={nodes} triggers={triggers} feeds={feeds} fed={fed}"
    return f"{counts} again={payload.hex()}"


def test_logics() -> None:
    results = set()
    for v in read(VECTORS / "logics.txt"):
        if v.word == "logic-check":
            result, at = check_logic(v)
            results.add(result)
            assert v.answer == f"{result} wrong={at}", v
        elif v.word == "logic-encode":
            made = write_logic(v)
            fits = len(made) <= v.number("capacity")
            assert v.answer == (f"payload={made.hex()}" if fits else "refused"), v
        else:
            try:
                said = read_logic(v.bytes("payload"))
            except ValueError:
                said = "malformed"
            assert v.answer == said, v
    assert results == {"good", "kind", "missing", "cycle", "limits"}


REPORT_COUNTS = ("refused", "late", "gaps", "kept", "first")


def write_report(v: Vector) -> bytes:
    told = v.numbers("readings")
    out = v.number("logic").to_bytes(4, "little")
    out += bytes([v.number("result"), v.number("wrong")])
    out += b"".join(n.to_bytes(4, "little") for n in v.numbers("next"))
    out += b"".join(v.number(n).to_bytes(4, "little") for n in REPORT_COUNTS)
    out += bytes([len(told) // 3])
    base = v.number("base_us") if told else 0
    times = [base + n for n in told[1::3]]
    out += ((times[0] if times else 0) % (1 << 64)).to_bytes(8, "little")
    last, value = (times[0] if times else 0), 0
    for trigger, time, next_value in zip(told[0::3], times, told[2::3], strict=True):
        out += bytes([trigger]) + zigzag(time - last) + zigzag(wrapped(next_value - value))
        last, value = time, next_value
    return out


def read_report(payload: bytes) -> str:
    r = Reader(payload)
    said = f"logic={r.number(4)} result={r.number(1)} wrong={r.number(1)}"
    said += "".join(f" next={r.number(4)}" for _ in range(11))
    said += "".join(f" {name}={r.number(4)}" for name in REPORT_COUNTS)
    count = r.number(1)
    check(count <= REPORTED)
    time, value = r.number(8, signed=True), 0
    for _ in range(count):
        trigger = r.number(1)
        time = wrapped(time + r.varint(), 64)
        value = wrapped(value + r.varint())
        said += f" trigger={trigger} time_us={time} value={value}"
    r.end()
    return said


def test_reports() -> None:
    malformed = 0
    for v in read(VECTORS / "reports.txt"):
        if v.word == "report-encode":
            made = write_report(v)
            fits = len(made) <= v.number("capacity") and "count" not in v.given
            assert v.answer == (f"payload={made.hex()}" if fits else "refused"), v
            continue
        try:
            said = read_report(v.bytes("payload"))
        except ValueError:
            said = "malformed"
            malformed += 1
        assert v.answer == said, v
    assert malformed > 50
