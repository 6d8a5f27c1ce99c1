"""What a stage may say: devices that play event streams and ramps in one time (strobe.yaml), and
give each other values (gear.yaml).

Names stand for tracks, what others feed, a device's inputs and its nodes. A node may be written
before those that it reads; they are sorted, and a cycle is told by the name of a node in it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from headway.configs.mistakes.mistake import ConfigError, KeyPath, Mistake, Place
from headway.configs.mistakes.source import read_text, read_yaml
from headway.configs.mistakes.tree import Table, places_at
from headway.configs.mistakes.words import clean
from headway.configs.schema import Channel, Sync
from headway.configs.section import Section

Int32 = Annotated[int, Field(ge=-(2**31), le=2**31 - 1)]
Time = Annotated[int, Field(ge=0, le=3_600_000_000)]  # us from the begin of the play
Count = Annotated[int, Field(ge=1, le=10_000)]
TRACKS_MAX, NODES_MAX, FEEDS_MAX, PORTS_MAX = 11, 16, 4, 4
LONGEST_US = 1 << 30  # of a ramp, see piece.h
TWO = ("add", "multiply", "gate")  # kinds of nodes that read b
Period = Annotated[float, Field(ge=1, le=1e9, allow_inf_nan=False)]  # us
Counts = Annotated[float, Field(ge=-50_000, le=50_000, allow_inf_nan=False)]
INPUTS = (
    "position", "error", "torque", "supply", "state",
    "digital0", "digital1", "digital2", "digital3", "lag",
)  # fmt: skip


class Stream(Section):
    """Events at even intervals: on, and a while later off."""

    start_us: Time
    every_us: Annotated[int, Field(ge=1, le=3_600_000_000)]
    on_us: Annotated[int, Field(ge=1, le=3_600_000_000)]
    times: Count
    value: Int32 = 1


class Ramp(Section):
    """Straight from one value to another, held from then on. Without a start it goes on from the
    end of the ramp before, without a first value from what the track has there."""

    start_us: Time | None = None
    end_us: Time
    first: Int32 | None = None
    last: Int32


class Track(Section):
    """A stream or ramps."""

    stream: Stream | None = None
    ramps: Annotated[list[Ramp], Field(default_factory=list)]


class Node(Section):
    """One value made of others, each servo period."""

    kind: Literal["add", "multiply", "compare", "window", "gate", "edge", "past"]
    a: str
    b: str = ""
    low: Int32 = 0
    high: Int32 = 0
    by_us: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = None
    """Of `past`: how long ago."""
    otherwise: Int32 = 0
    """Of `past`: its value where the track does not reach back so far."""

    @property
    def reads(self) -> tuple[str, ...]:
        """The names of what it reads."""
        return (self.a, self.b) if self.kind in TWO else (self.a,)


class Feed(Section):
    """A value that a device gives the others, over wires between them: for these it is a track."""

    kind: Literal["ramp", "step"] = "ramp"
    """Straight lines from point to point, or each value until the next."""
    of: str
    every: Annotated[int, Field(ge=1, le=1000)] = 4
    """Servo periods from one frame to the next."""
    after_us: Annotated[int, Field(ge=0, le=65535)] = 8000
    """How long after its time a value holds at the others."""


class Reading(Section):
    """What is sampled, and when."""

    kind: Literal["interval", "edge", "window"]
    read: str
    when: str = ""
    every: Annotated[int, Field(ge=1, le=65535)] = 1
    """Servo periods."""
    fold_us: Period | None = None
    """The period of what is read, to put its samples together by."""


class Sensor(Section):
    """What a device's encoder shows: a wave of two harmonics [counts]. From one servo period to the
    next it changes by fewer counts than a spike (2^18)."""

    period_us: Period
    amplitude: Counts = 1000.0
    second: Counts = 300.0


class Player(Section):
    """A device of the stage."""

    drift_ppm: Annotated[float, Field(ge=-250, le=250)] = 0.0
    digital: Annotated[list[str], Field(default_factory=list, max_length=4)]
    pwm: Annotated[list[str], Field(default_factory=list, max_length=2)]
    nodes: Annotated[dict[str, Node], Field(default_factory=dict, max_length=NODES_MAX)]
    readings: Annotated[list[Reading], Field(default_factory=list, max_length=4)]
    feeds: Annotated[dict[str, Feed], Field(default_factory=dict, max_length=FEEDS_MAX)]
    sensor: Sensor | None = None

    @property
    def uses(self) -> set[str]:
        """The names of all that it reads."""
        used = {*self.digital, *self.pwm, *(f.of for f in self.feeds.values())}
        used |= {r for n in self.nodes.values() for r in n.reads}
        return used | {r for reading in self.readings for r in (reading.read, reading.when)}


class Stage(Section):
    """Devices, each by a wire of its own from one host, and the tracks that they play."""

    name: str
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    settle_s: Annotated[float, Field(ge=1, le=60)] = 3.0
    duration_s: Annotated[float, Field(gt=0, le=600)]
    servo_period_us: Annotated[int, Field(ge=100, le=10_000)] = 1000
    wire: Channel = Channel()
    mesh: Channel = Channel()
    """The wires between devices of which one reads what the other feeds."""
    sync: Sync = Sync()
    tracks: Annotated[dict[str, Track], Field(max_length=TRACKS_MAX)]
    devices: Annotated[dict[str, Player], Field(min_length=1)]

    @property
    def feeds(self) -> dict[str, str]:
        """The feeds' names, and whose they are."""
        return {feed: name for name, device in self.devices.items() for feed in device.feeds}

    @property
    def cables(self) -> list[tuple[str, str]]:
        """Devices of which one reads what the other feeds, each two once."""
        feeds, found = self.feeds, list[tuple[str, str]]()
        for name, device in self.devices.items():
            for feed in sorted(device.uses & set(feeds)):
                pair = (feeds[feed], name)
                if pair not in found and pair[::-1] not in found:
                    found.append(pair)
        return found


def order(nodes: dict[str, Node]) -> list[str]:
    """The nodes' names, each after those that it reads. Raises ValueError with the name of one in a
    cycle."""
    done: list[str] = []
    open_: list[str] = []

    def visit(name: str) -> None:
        if name in done:
            return
        if name in open_:
            raise ValueError(name)
        open_.append(name)
        for read in nodes[name].reads:
            if read in nodes:
                visit(read)
        open_.remove(name)
        done.append(name)

    for name in nodes:
        visit(name)
    return done


def load_stage(path: Path) -> Stage:
    """Raises ConfigError with all mistakes, each with its key and its line."""
    source = Place(clean(str(path), 4096))
    tree, mistakes = read_yaml(read_text(path), source)
    if not isinstance(tree, Table):
        text = "is no section of keys: start from a copy of configs/strobe.yaml"
        raise ConfigError(*mistakes, Mistake(source, (), text))

    def mistake(key: KeyPath, text: str) -> Mistake:
        for length in range(len(key), -1, -1):
            places = places_at(tree, key[:length])
            if places:
                return Mistake(places[0], key, text)
        return Mistake(source, key, text)

    try:
        stage = Stage.model_validate(tree)
    except ValidationError as error:
        for problem in error.errors(include_url=False, include_context=False):
            text = problem["msg"].removeprefix("Value error, ")
            if problem["type"] == "extra_forbidden":
                text = "there is no such key here; configs/strobe.yaml and configs/gear.yaml show "
                text += "those that there are"
            mistakes.append(mistake(tuple(problem["loc"]), text))
        raise ConfigError(*mistakes) from error
    mistakes += [mistake(key, text) for key, text in _unknown(stage)]
    if mistakes:
        raise ConfigError(*mistakes)
    return stage


def _track(track: Track) -> list[tuple[KeyPath, str]]:
    """What cannot be of a track."""
    stream, found = track.stream, list[tuple[KeyPath, str]]()
    if (stream is None) == (not track.ramps):
        found.append(((), "give either a stream or ramps"))
    if stream is not None and stream.times > 1 and stream.on_us >= stream.every_us:
        text = f"is not below every_us, {stream.every_us}: it goes on again before it is off"
        found.append((("stream", "on_us"), text))
    before_us = end_us = 0
    for i, ramp in enumerate(track.ramps):
        if i == 0 and (ramp.start_us is None or ramp.first is None):
            found.append((("ramps", 0), "the first ramp needs start_us and first"))
        start_us = end_us if ramp.start_us is None else ramp.start_us
        if start_us < before_us:
            text = f"is before the start of the ramp before it, {before_us}"
            found.append((("ramps", i, "start_us"), text))
        if not 0 <= ramp.end_us - start_us <= LONGEST_US:
            text = f"has to be from its start, {start_us}, to {LONGEST_US} us after it"
            found.append((("ramps", i, "end_us"), text))
        before_us, end_us = start_us, ramp.end_us
    return found


def _unknown(stage: Stage) -> list[tuple[KeyPath, str]]:
    """Names that stand for nothing or for two things, cycles, and tracks that cannot be."""
    found: list[tuple[KeyPath, str]] = []
    for name, track in stage.tracks.items():
        found += [(("tracks", name, *key), text) for key, text in _track(track)]
        if name in INPUTS:
            found.append((("tracks", name), "is the name of an input: give it another one"))
    for name, device in stage.devices.items():
        others = [feed for feed, owner in stage.feeds.items() if owner != name]
        past = [*stage.tracks, *others]
        known = [*past, *INPUTS, *device.nodes]

        def check(key: KeyPath, read: str, known: list[str] = known) -> None:
            if read not in known:
                text = f"there is no {read!r}; there are: {', '.join(known)}"
                found.append((key, text))

        at: KeyPath = ("devices", name)
        for i, read in enumerate(device.digital):
            check((*at, "digital", i), read)
        for i, read in enumerate(device.pwm):
            check((*at, "pwm", i), read)
        for node, of in device.nodes.items():
            key = (*at, "nodes", node)
            if node in stage.tracks or node in INPUTS:
                what = "an input" if node in INPUTS else "a track"
                found.append((key, f"is the name of {what}: give it another one"))
            check((*key, "a"), of.a)
            if of.kind in TWO:
                check((*key, "b"), of.b)
            if of.low > of.high:
                found.append(((*key, "low"), f"is above high, {of.high}"))
            if of.kind == "past" and of.a in known and of.a not in past:
                there = ", ".join(past)
                text = f"is no track: of nothing else the past is kept; there are: {there}"
                found.append(((*key, "a"), text))
            if (of.kind == "past") != (of.by_us is not None):
                text = "say how long ago: by_us" if of.kind == "past" else "only of kind past"
                found.append(((*key, "by_us"), text))
        for key, text in _feeds(stage, name):
            found.append(((*at, *key), text))
        for feed, fed in device.feeds.items():
            check((*at, "feeds", feed, "of"), fed.of)
        for i, reading in enumerate(device.readings):
            check((*at, "readings", i, "read"), reading.read)
            if reading.kind != "interval":
                check((*at, "readings", i, "when"), reading.when)
        try:
            order(device.nodes)
        except ValueError as error:
            text = "reads itself, at once or by way of others: have it read something else"
            found.append(((*at, "nodes", str(error)), text))
    return found


def _feeds(stage: Stage, name: str) -> list[tuple[KeyPath, str]]:
    """Names of feeds that stand for two things, and more of them than there is room for."""
    device, found = stage.devices[name], list[tuple[KeyPath, str]]()
    nodes = (node for other in stage.devices.values() for node in other.nodes)
    taken = {*stage.tracks, *INPUTS, *nodes}
    for feed in device.feeds:
        if feed in taken or stage.feeds[feed] != name:
            text = "is the name of something else: give it another one"
            found.append((("feeds", feed), text))
    fed = device.uses & {feed for feed, owner in stage.feeds.items() if owner != name}
    if len(fed) > FEEDS_MAX:
        found.append(((), f"reads {len(fed)} feeds of others: a device takes {FEEDS_MAX}"))
    if len(stage.tracks) + len(stage.feeds) > TRACKS_MAX:
        text = f"is a track beyond the {TRACKS_MAX} that a device has"
        found += [(("feeds", feed), text) for feed in device.feeds]
    wires = sum(name in cable for cable in stage.cables)
    if wires > PORTS_MAX:
        found.append(((), f"is wired to {wires} others by feeds: a board has {PORTS_MAX} ports"))
    return found
