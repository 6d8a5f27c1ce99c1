"""Vectors of a board that asks those beside it for their time, and answers them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from random import Random

from line import Value, line
from peer import feed, request, response

from headway.firmware import _core

WRAP, HALF = 1 << 32, 1 << 31
OPEN = (1 << 31) - 1  # an error that is not known
EPOCH_US = 1_700_000_000_000_123
RATE_MAX = 2_147_484
DRAW_STEP = 0x9E3779B97F4A7C15
BLUR_MAX_US = 1_000_000
STARTS = (0, 5_000_000, HALF - 3000, WRAP - 3000)


@dataclass
class _Board:
    """Lines of one board, which goes on through the counter's ends."""

    rng: Random
    count: int
    ports: int = 0b10
    ask_us: int = 8000
    dither_us: int = 0
    rate_q32: int = 0
    own: int = 7  # its number
    among: bool = False  # its time is the boards' own
    key: bytes = field(default_factory=lambda: bytes(range(16)))

    def begin(self) -> str:
        return line(
            "neighbours", count_us=self.count, base_us=EPOCH_US - self.count,
            rate_q32=self.rate_q32, id=self.own, ports=self.ports, ask_us=self.ask_us,
            dither_us=self.dither_us, peer_least_us=self.rng.randrange(1_000_001), key=self.key,
            **({"among": 1} if self.among else {}),
        )  # fmt: skip

    def go(self, elapsed_us: int) -> None:
        self.count = (self.count + elapsed_us) % WRAP

    def period(
        self, least: int = -300, most: int = 400, lineage: int = 9, settled: bool = True
    ) -> str:
        return line(
            "neighbours-period", count_us=self.count, lineage=lineage, settled=settled,
            least_error_ns=least, most_error_ns=most,
        )  # fmt: skip

    def speak(self, random: int | None = None) -> str:
        drawn = self.rng.getrandbits(64) if random is None else random
        return line("neighbours-speak", count_us=self.count, random=f"{drawn:016x}")

    def take(self, port: int, frame: bytes, ago_us: int = 0, random: int | None = None) -> str:
        drawn = self.rng.getrandbits(64) if random is None else random
        given: dict[str, Value] = {"port": port, "frame": frame}
        given |= {"arrived_us": (self.count - ago_us) % WRAP, "count_us": self.count}
        return line("neighbours-take", **given, random=f"{drawn:016x}")

    def asked(self, port: int, **more: int) -> str:
        """A neighbour's question."""
        return self.take(port, request(self.key, self.rng.getrandbits(64)), **more)

    def told(self, nonce: int) -> bytes:
        """A neighbour's answer, of anything."""
        times = (self.rng.randrange(-(1 << 60), 1 << 60) for _ in range(2))
        errors = (self.rng.randrange(-OPEN, OPEN) for _ in range(2))
        return response(self.key, nonce, *times, *errors, self.rng.getrandbits(32), 1)


def _draw(first: int, index: int) -> int:
    """What a board draws as the `index`-th of a call."""
    return (first + index * DRAW_STEP) % (1 << 64)


def _pauses(rng: Random) -> Iterator[str]:
    """To the microsecond, with the shortest, the longest, and intervals that no quarter divides."""
    for start, ask_us, low in (
        (0, 8000, 0), (0, 1000, 1), (0, 1003, 0xFFFF), (0, 10_000_000, 0xFFFF),
        (HALF - 3000, 1002, 0x7FFF), (WRAP - 3000, 8001, 0xFFFF),
    ):  # fmt: skip
        board = _Board(rng, start, ask_us=ask_us)
        yield board.begin()
        if low % 2:  # at the count 0 a pause of none is over at once
            yield board.speak(0)
        board.go(10_000_001)
        yield board.speak(0x0123_4567_89AB_0000 | low)
        quarter = ask_us // 4
        pause = ask_us - quarter + (low * 2 * quarter >> 16)
        for elapsed in (0, pause - 1, 1, 1, pause - 1):
            board.go(elapsed)
            yield board.speak(low)


def _questions(rng: Random) -> Iterator[str]:
    """Every port, and whose answer counts: of the last question at that port, once."""
    for start, ports in zip(STARTS * 2, (0b1_1110, 0, 0b10, 0b1_0110, 0b1000), strict=False):
        board = _Board(rng, start, ports=ports)
        yield board.begin()
        yield from (board.take(port, board.told(0)) for port in range(5))  # nothing was asked
        board.go(10_000)
        first = rng.getrandbits(64)
        yield board.speak(first)
        named = [port for port in range(1, 5) if ports >> port & 1]
        nonces = {port: _draw(first, 1 + i) for i, port in enumerate(named)}
        board.go(700)
        for port in range(5):
            for other in (*named[:2], 0):
                if other != port:
                    yield board.take(port, board.told(nonces.get(other, first)), ago_us=2)
        for port in reversed(named):
            broken = bytearray(board.told(nonces[port]))
            broken[17] ^= 1
            yield board.take(port, bytes(broken), ago_us=3)
            yield board.take(port, board.told(nonces[port]), ago_us=rng.randrange(400))
            yield board.take(port, board.told(nonces[port]))
        board.go(10_000)
        second = rng.getrandbits(64)
        yield board.speak(second)
        yield line("neighbours-flush")  # of what the others asked
        for i, port in enumerate(named[:2]):
            yield board.take(port, board.told(nonces[port]))
            yield board.take(port, board.told(_draw(second, 1 + i)))


def _demands(rng: Random) -> Iterator[str]:
    """Answers wait for their time, the last question's alone; a step ends them."""
    for start, dither_us, wait_us in (
        (0, 0, 3), (0, 1, 1), (0, 65_535, 65_534), (HALF - 60, 5000, 499), (WRAP - 60, 5000, 5499),
    ):  # fmt: skip
        board = _Board(rng, start, ports=0b1_1110, dither_us=dither_us, ask_us=10_000_000)
        yield board.begin()
        yield board.speak()
        yield board.period()
        board.go(50)
        for port in (0, 1, 4):
            yield board.asked(port, ago_us=rng.randrange(50), random=wait_us)
        for elapsed in (0, wait_us % max(1, dither_us) - 1, 1, 1):
            board.go(max(0, elapsed))
            yield board.speak()
        yield board.asked(2, random=7)
        board.go(3)
        yield board.asked(2, random=wait_us)  # another one, before it is answered
        board.go(70_000)
        yield board.speak()
        yield board.speak()
        for port in range(1, 5):
            yield board.asked(port)
        yield line("neighbours-flush")
        board.go(70_000)
        yield board.speak()
    board = _Board(rng, 99, ports=0b110)
    yield board.begin()
    for port in range(4):
        yield board.take(port, request(bytes(16), 5))
        yield board.take(port, _core.cobs_encode(request(board.key, 5)))
        yield board.take(port, b"")
        yield board.asked(port)
    yield board.speak()
    board = _Board(rng, 99, ports=0b1111_1111)  # the host is never asked, and has no answer
    yield board.begin()
    yield board.speak()
    yield from (board.asked(port) for port in range(5))
    yield board.speak()


def _answers(rng: Random) -> Iterator[str]:
    """Times by clocks of all rates; errors widened by what has passed, and at their ends."""
    for start, rate_q32 in zip(STARTS, (RATE_MAX, -1, -RATE_MAX, 0), strict=True):
        board = _Board(rng, start, rate_q32=rate_q32, ask_us=10_000_000)
        yield board.begin()
        yield board.speak()
        for since, asked in ((0, 0), (0, 1), (999, 400), (400, 999), (250, 250)):
            yield board.period(settled=since < asked, lineage=rng.choice([7, 9, 0]))
            board.go(since)
            yield board.asked(1, ago_us=asked)
            yield board.speak()
        yield board.period()
        for waited in (BLUR_MAX_US - 1, BLUR_MAX_US, BLUR_MAX_US + 1, 1_999_999, HALF - 1):
            yield board.asked(1)
            board.go(waited)
            yield board.speak()
            yield board.period()
    for own, lineage in ((7, 7), (7, 9), (0, 0)):
        board = _Board(rng, 77, own=own, ask_us=10_000_000)
        yield board.begin()
        yield board.speak()
        for elapsed in (0, 1, 1250, BLUR_MAX_US):
            blur = 1 + elapsed * 800 // 1000
            for error in (OPEN, OPEN - blur, OPEN - blur + 1, OPEN - blur - 1, blur, 0):
                yield board.period(-error, error, lineage, settled=error == 0)
                yield board.asked(1, ago_us=700 if elapsed == 0 else 0)
                board.go(elapsed)
                yield board.speak()


def _feeds(rng: Random) -> Iterator[str]:
    """What a board gives in each period, to all that it knows; and what it takes, of its time."""
    for start, ports, among in ((5, 0b11_0110, False), (WRAP - 9000, 0b100, True)):
        board = _Board(rng, start, ports=ports, ask_us=10_000_000, among=among)
        yield board.begin()
        yield board.speak()
        yield board.period()
        yield board.speak()  # there is no logic
        for every, value in ((1, 5), (3, -(1 << 30))):
            feeds = [(0, 16, 300 + every, every, 4000), (1, 17, 9, 2, 65_535)]
            logic = _core.logic_encode(1, [], [], [], [], feeds, [(5, 77)])
            values = [16, value, 17, value % 2]
            yield line("neighbours-logic", payload=logic, values=values)
            for i in range(6 if among else 2):
                board.go(1000)
                yield board.period(settled=i != 4, lineage=9)
                yield board.speak()
                yield board.speak()  # in between: the other one, and then none
                yield board.speak()
        now_us = EPOCH_US - start + board.count
        for number, lineage, off_us in (
            (77, 0, 0), (77, 9, 0), (78, 0, 0), (78, 9, 0), (77, 9 * among, 100_000),
            (77, 9 * among, 100_001), (77, 9 * among, -100_000), (77, 9 * among, -100_001),
        ):  # fmt: skip
            frame = feed(board.key, number, 1, lineage, now_us + off_us, [(0, 3)])
            yield board.take(2, frame)
        yield board.take(2, feed(board.key, 77, 1, 9 * among, now_us, [(0, 3)], 0))
        yield board.take(1, feed(board.key, 77, 1, 9 * among, now_us, [(0, 3)]))
        yield board.take(2, feed(bytes(16), 77, 1, 9 * among, now_us, [(0, 3)]))
        logic = _core.logic_encode(1, [], [], [], [], [(0, 25, 5, 1, 0)], [(5, 77)])
        yield line("neighbours-logic", payload=logic, values=[16, 0])
        for _ in range(3):  # how long ago all was known
            board.go(60_000)
            yield board.period()
            yield board.speak()
        yield board.period(settled=False)
        yield board.take(2, feed(board.key, 77, 1, 9 * among, now_us, [(0, 3)]))
        yield line(
            "neighbours-logic", payload=_core.logic_encode(1, [], [], [], []), values=[16, 0]
        )
        board.go(1000)
        yield board.period()
        yield board.speak()


def neighbours(rng: Random) -> Iterator[str]:
    """Pauses, questions, answers and what becomes of those of others."""
    yield from _pauses(rng)
    yield from _questions(rng)
    yield from _demands(rng)
    yield from _answers(rng)
    yield from _feeds(rng)
