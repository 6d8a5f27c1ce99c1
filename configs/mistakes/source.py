"""Reads YAML into a tree with places, and says what is wrong with a file that is none."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
)
from ruamel.yaml.reader import ReaderError

from headway.configs.mistakes.mistake import ConfigError, Mistake, Place
from headway.configs.mistakes.tree import Row, Table
from headway.configs.mistakes.words import clean

SIZE_MAX = 200_000  # bytes; YAML is slow to read, and more than this is some other file
DEPTH_MAX = 32  # of nesting
ENTRIES_MAX = 10_000  # with all aliases written out
DIGITS_MAX = 40  # of an exact integer; Python takes its time over very long ones
PLAIN = (None, "")  # a scalar's style without quotes
UNFINISHED = object()  # the value of an anchor within what it names
UNKNOWABLE = object()  # a value that is told to be wrong already

# YAML 1.2, section 10.3.2, the core schema: what text without quotes means.
_SCALARS: tuple[tuple[str, Callable[[str], Any]], ...] = (
    (r"|~|null|Null|NULL", lambda _: None),
    (r"true|True|TRUE", lambda _: True),
    (r"false|False|FALSE", lambda _: False),
    (r"[-+]?[0-9]+", lambda text: int(text) if len(text) <= DIGITS_MAX else float(text)),
    (r"0o[0-7]+", lambda text: int(text[2:], 8)),
    (r"0x[0-9a-fA-F]+", lambda text: int(text[2:], 16)),
    (r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", float),
    (r"[-+]?\.(inf|Inf|INF)", lambda text: float(text.replace(".", ""))),
    (r"\.(nan|NaN|NAN)", lambda _: float("nan")),
)
SCALARS = [(re.compile(pattern), make) for pattern, make in _SCALARS]

# What ruamel.yaml says, whether the mistake is where it began to read, and what we say.
_SYNTAX = (
    (r"quoted scalar.*unexpected", True, "the quote that begins here has no end"),
    (
        r"expected ',' or '(.)'",
        True,
        r"what begins here has no end: a `\1` or a comma is missing{line}",
    ),
    (r"content, but found '<", False, "a value or a closing bracket is missing before this"),
    (r"content, but found '(.)'", False, r"a value is missing before this `\1`, or it is too many"),
    (
        r"expected <block end>",
        False,
        "this line does not fit under those above it: indent it like its neighbours",
    ),
    (
        r"mapping values are not allowed",
        False,
        "this `:` does not fit here: check its indentation and the line above; a key needs `: ` "
        "after it, text that has a colon needs quotes",
    ),
    (
        r"sequence entries are not allowed",
        False,
        "a list's `- ` begins a line, indented like its neighbours",
    ),
    (r"could not find expected ':'", True, "a key needs `: ` after it, a colon and a space"),
    (r"character '\\t'", False, "a tab: indent with spaces"),
    (r"character '(.)' that cannot", False, r"no value begins with `\1`: put it into quotes"),
    (
        r"unknown escape character '(.*)'",
        False,
        r"`\\\1` means nothing in double quotes: use single quotes",
    ),
    (r"expected '<document start>'", False, "nothing can follow here: is a bracket too many?"),
)
SYNTAX = [(re.compile(pattern), begun, words) for pattern, begun, words in _SYNTAX]


def read_text(path: Path) -> str:
    """The text of a config file. Raises ConfigError if there is none."""
    try:
        with path.open("rb") as file:
            content = file.read(SIZE_MAX + 1)
    except FileNotFoundError as error:
        found = near(path)
        text = f"cannot be read: there is no such file in {path.parent.absolute()}"
        meant = f"; did you mean {path.with_name(found)}?" if found else ""
        raise _refused(path, text + meant) from error
    except IsADirectoryError as error:
        raise _refused(path, "cannot be read: it is a folder; name a file in it") from error
    except OSError as error:
        why = error.strerror or str(error)
        raise _refused(path, f"cannot be read: {why}; check the path and your rights") from error
    if len(content) > SIZE_MAX:
        raise _refused(path, f"is too large for a config: more than {SIZE_MAX} bytes")
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise _refused(path, "is UTF-16 text: save it as UTF-8")
    if b"\0" in content:
        raise _refused(path, "is not text, or not UTF-8: it has zero bytes; save it as UTF-8 text")
    try:
        return content.decode()  # ruamel skips a byte order mark
    except UnicodeDecodeError as error:
        before = content[: error.start].decode()
        text = f"the byte {content[error.start]:#04x} is not UTF-8: save the file as UTF-8"
        raise ConfigError(Mistake(_position(Place(str(path)), before), (), text)) from error


def near(path: Path) -> str | None:
    """The name of a file beside `path` that is similar to its own."""
    try:
        names = os.listdir(path.parent)
    except (OSError, ValueError):
        return None
    return next(iter(difflib.get_close_matches(path.name, names, 1)), None)


def read_yaml(text: str, source: Place) -> tuple[Any, list[Mistake]]:
    """What a YAML text says: Table, Row, str, int, float, bool or None; and what is wrong in it.

    `source` is the file or the `--set` that it is in. Raises ConfigError where it cannot be read
    any further.
    """
    reader = _Reader(source)
    try:
        for event in _events(text):
            reader.take(event)
    except MarkedYAMLError as error:
        raise ConfigError(_syntax(error, source)) from error
    except ReaderError as error:
        place, what = _position(source, text[: error.position]), text[error.position]
        words = f"the character {what!r} is not allowed in YAML: remove it"
        raise ConfigError(Mistake(place, (), words)) from error
    except (OverflowError, ValueError) as error:  # from `\U...` in double quotes
        words = "is not YAML: an escape in double quotes, here or soon after, is no character"
        raise ConfigError(Mistake(reader.place, (), words)) from error
    return reader.value, reader.mistakes


def _refused(path: Path, why: str) -> ConfigError:
    return ConfigError(Mistake(Place(str(path)), (), why))


def _position(source: Place, before: str) -> Place:
    """The place behind the text `before`."""
    return source.within(before.count("\n") + 1, len(before) - before.rfind("\n"))


def _events(text: str) -> Iterator[Any]:
    yield from YAML(typ="safe", pure=True).parse(text)


def _syntax(error: MarkedYAMLError, source: Place) -> Mistake:
    told = f"{error.context or ''}: {error.problem or ''}"
    mark, words = error.problem_mark or error.context_mark, error.problem
    for pattern, begun, ours in SYNTAX:
        if found := pattern.search(told):
            begin = error.context_mark if begun and error.context_mark else mark
            later = f", in line {mark.line + 1} at the latest" if mark.line > begin.line else ""
            words, mark = found.expand(ours).replace("{line}", later), begin
            break
    place = source.within(mark.line + 1, mark.column + 1) if mark else source
    return Mistake(place, (), f"is not YAML: {words}")


def _scalar(event: ScalarEvent) -> Any:
    if event.style not in PLAIN:  # quoted, or a block
        return event.value
    for pattern, make in SCALARS:
        if pattern.fullmatch(event.value):
            return make(event.value)
    return event.value


class _Open:
    """A mapping or list of which more is to come."""

    def __init__(self, node: Table | Row, place: Place, anchor: str | None) -> None:
        self.node, self.place, self.anchor = node, place, anchor
        self.key: str | None = None  # of a mapping, whose value comes next
        self.key_place = place
        self.ignored = False  # the next value: its key is wrong
        self.merging = False  # the next value: its key is <<
        self.merged: list[Table] = []


class _Reader:
    """Makes a tree of YAML's events, without recursion."""

    def __init__(self, source: Place) -> None:
        self.value: Any = None
        self.mistakes: list[Mistake] = []
        self.place = source  # of the event
        self._source, self._documents = source, 0
        self._open: list[_Open] = []
        self._anchors: dict[str, Any] = {}

    def take(self, event: Any) -> None:
        """Raises ConfigError for what is too much."""
        self.place = self._source.within(event.start_mark.line + 1, event.start_mark.column + 1)
        if isinstance(event, DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise self._refused("a second document begins here: a config is one; remove `---`")
        elif isinstance(event, CollectionEndEvent):
            self._close()
        elif isinstance(event, NodeEvent):
            self._node(event)

    def _node(self, event: Any) -> None:
        if getattr(event, "tag", None) is not None:
            tag = clean(str(event.tag).replace("tag:yaml.org,2002:", "!!"))
            self._tell(f"the tag {tag} has no place in a config: leave it out")
        if isinstance(event, AliasEvent):
            self._add(self._alias(event.anchor), self.place)
        elif isinstance(event, CollectionStartEvent):
            node = Table() if isinstance(event, MappingStartEvent) else Row()
            if event.anchor:
                self._anchors[event.anchor] = UNFINISHED
            self._open.append(_Open(node, self.place, event.anchor))
            self._check_size()
        else:
            value = _scalar(event)
            if event.anchor:
                self._anchors[event.anchor] = value
            self._add(value, self.place, event)

    def _alias(self, name: str) -> Any:
        value = self._anchors.get(name, UNKNOWABLE)
        if value is UNFINISHED:
            self._tell(f"*{clean(name)} stands within what it repeats: that has no end")
            return UNKNOWABLE
        if name not in self._anchors:
            self._tell(f"*{clean(name)} repeats what has no name: write &{clean(name)} before it")
        return value

    def _add(self, value: Any, place: Place, scalar: ScalarEvent | None = None) -> None:
        """Puts a value where it belongs; in a mapping every other one is a key."""
        if not self._open:
            self.value = value
            return
        top = self._open[-1]
        if isinstance(top.node, Row):
            top.node.add(value, place)
        elif top.key is not None:
            empty = value is None and scalar is not None and not scalar.value
            top.node.put(top.key, value, (top.key_place, top.key_place if empty else place))
            top.key = None
        elif top.merging:
            self._merge(top, value)
        elif top.ignored:
            top.ignored = False
            top.node.entries += 1
        else:
            self._key(top, place, scalar)
        self._check_size()

    def _key(self, top: _Open, place: Place, scalar: ScalarEvent | None) -> None:
        top.key_place = place
        if scalar is None or not scalar.value or not scalar.value.isprintable():
            self._tell("a key is a word, as `name` in `name: arm2`")
            top.ignored = True
        elif scalar.value == "<<" and scalar.style in PLAIN:
            top.merging = True
        elif scalar.value in top.node and isinstance(top.node, Table):
            first = top.node.places[scalar.value][0]
            where = f"first in line {first.line}" if first.line else "keep one"
            self._tell(f"this key is given twice, {where}: remove one of the two", scalar.value)
            top.ignored = True
        else:
            top.key = scalar.value

    def _merge(self, top: _Open, value: Any) -> None:
        top.merging = False
        tables = value if isinstance(value, Row) else [value]
        if not all(isinstance(table, Table) for table in tables):
            if value is not UNKNOWABLE:
                self._tell("`<<` takes in the keys of a mapping: write `<<: *name`")
            return
        top.merged += tables
        top.node.entries += sum(table.entries for table in tables)

    def _close(self) -> None:
        done = self._open.pop()
        self.place = done.place
        if isinstance(done.node, Table):
            for table in done.merged:
                for key in table.keys() - done.node.keys():
                    done.node.put(key, table[key], table.places[key])
        if done.anchor:
            self._anchors[done.anchor] = done.node
        self._add(done.node, done.place)

    def _check_size(self) -> None:
        node = self._open[-1].node
        if len(self._open) - 1 + node.depth > DEPTH_MAX:
            raise self._refused(f"is nested deeper than {DEPTH_MAX} levels: this is no config")
        if node.entries > ENTRIES_MAX:
            raise self._refused(f"has more than {ENTRIES_MAX} entries: this is no config")

    def _tell(self, text: str, *key: str) -> None:
        path: list[int | str] = []
        for opened in self._open:
            if isinstance(opened.node, Row):
                path.append(len(opened.node))
            elif opened.key is not None:
                path.append(opened.key)
        self.mistakes.append(Mistake(self.place, (*path, *key), text))

    def _refused(self, why: str) -> ConfigError:
        return ConfigError(Mistake(self.place, (), why))
