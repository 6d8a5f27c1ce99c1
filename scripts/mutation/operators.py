"""What is changed in C source, one thing at a time; docs/mutation.md lists it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

from tokens import Function, Source

Enums = Mapping[str, tuple[str, ...]]  # each enumerator: all of its enumeration

RELATIONS = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=", "<=", ">="),
    "!=": ("==", "<", ">"),
}
ARITHMETIC = {
    "+": ("-",),
    "-": ("+",),
    "*": ("/", "+"),
    "/": ("*",),
    "%": ("/", "*"),
    "<<": (">>",),
    ">>": ("<<",),
    "&": ("|", "^"),
    "|": ("&", "^"),
    "^": ("&", "|"),
    "&&": ("||",),
    "||": ("&&",),
    "++": ("--",),
    "--": ("++",),
    "+=": ("-=", "="),
    "-=": ("+=", "="),
    "*=": ("/=", "="),
    "/=": ("*=", "="),
    "%=": ("/=", "="),
    "<<=": (">>=", "="),
    ">>=": ("<<=", "="),
    "&=": ("|=", "="),
    "|=": ("&=", "="),
    "^=": ("|=", "="),
}
_MAYBE_UNARY = ("+", "-", "*", "&")
_CONTROL = ("if", "while", "for", "switch", "else", "do", "case", "default", "return", "goto")


@dataclass(frozen=True)
class Mutant:
    """A change of one place: `text[start:end]` becomes `new`."""

    kind: str
    start: int
    end: int
    new: str
    lines: tuple[int, int]  # that its statement spans, from 1
    function: str  # "" outside of all
    label: str  # what became what, to be read


class Mutator:
    """All mutants of one source."""

    def __init__(self, source: Source, enums: Enums) -> None:
        self.source, self.enums = source, enums
        self._function: Function | None = None

    def mutants(self) -> list[Mutant]:
        """Sorted by place, each change once."""
        text = self.source.text
        found: dict[str, Mutant] = {}
        for mutant in self._all():
            changed = text[: mutant.start] + mutant.new + text[mutant.end :]
            if changed != text:
                found.setdefault(changed, mutant)
        return sorted(found.values(), key=lambda m: (m.start, m.end, m.new))

    def _all(self) -> Iterator[Mutant]:
        for function in self.source.functions:
            self._function = function
            yield from self._body(function)
            yield from self._tokens(function.open + 1, function.close)
            yield from self._statements(function.open + 1, function.close)
        self._function = None
        for begin, end in self._tables():
            yield from self._tokens(begin, end)

    def _tables(self) -> Iterator[tuple[int, int]]:
        """Initializers outside of functions."""
        source, i = self.source, 0
        bodies = {f.open: f.close for f in source.functions}
        while i < len(source.tokens):
            if i in bodies:
                i = bodies[i]
            elif source.tokens[i].text == "=" and source.tokens[i + 1].text == "{":
                yield i + 1, source.partner[i + 1] + 1
                i = source.partner[i + 1]
            elif source.tokens[i].text in ("(", "["):
                i = source.partner[i]
            i += 1

    def _make(self, kind: str, begin: int, end: int, new: str, label: str = "") -> Mutant:
        """Tokens [begin, end) become `new`."""
        source = self.source
        start, stop = source.tokens[begin].start, source.tokens[end - 1].end
        old = " ".join(source.text[start:stop].split())
        lines = self._statement_lines(begin, end)
        name = self._function.name if self._function else ""
        return Mutant(kind, start, stop, new, lines, name, label or f"{old} -> {new}")

    def _statement_lines(self, begin: int, end: int) -> tuple[int, int]:
        """Of the innermost statement, or the head of an `if` or a loop, around tokens."""
        low, high = begin, end - 1
        while low > 0 and not self._ends_statement(low - 1):
            low -= 1
        while high < len(self.source.tokens) - 1 and not self._ends_statement(high):
            high += 1
        return self.source.line(low), self.source.line(high)

    def _ends_statement(self, i: int) -> bool:
        tokens = self.source.tokens
        if tokens[i].text == ")":
            return tokens[self.source.partner[i] - 1].text in ("if", "while", "for", "switch")
        if tokens[i].text == ";":  # but not in the head of a loop, which ends with a bracket
            return i + 1 == len(tokens) or tokens[self.source.until(i + 1, ())].text != ")"
        return tokens[i].text in ("{", "}", "else")

    def _body(self, function: Function) -> Iterator[Mutant]:
        """The function does nothing."""
        if function.type == "void":
            new = "{ }"
        elif function.type.startswith("struct") and not function.type.endswith("*"):
            new = f"{{ return ({function.type}){{0}}; }}"
        else:
            new = "{ return 0; }"
        source = self.source
        start, end = source.tokens[function.open].start, source.tokens[function.close].end
        first = source.head_line(function)
        lines = first, source.line(function.close)
        yield Mutant("body", start, end, new, lines, function.name, f"body -> {new}")

    def _tokens(self, begin: int, end: int) -> Iterator[Mutant]:
        for i in range(begin, end):
            token = self.source.tokens[i]
            if token.kind == "symbol":
                yield from self._symbol(i)
            elif token.kind == "number":
                yield from self._number(i)
            elif token.kind == "name":
                yield from self._name(i)

    def _symbol(self, i: int) -> Iterator[Mutant]:
        source, text = self.source, self.source.tokens[i].text
        if text in RELATIONS:
            for new in RELATIONS[text]:
                if not self._is_same_by_type(i, new):
                    yield self._make("relation", i, i + 1, new)
        elif text in ARITHMETIC:
            if text not in _MAYBE_UNARY or source.is_binary(i):
                for new in ARITHMETIC[text]:
                    yield self._make("arithmetic", i, i + 1, new)
            elif text == "-":
                yield self._make("sign", i, i + 1, "", "unary - removed")
        elif text in ("!", "~"):
            yield self._make("negation", i, i + 1, "", f"{text} removed")
        elif text == "?":
            yield from self._choice(i)
        elif text == "(" and source.is_cast(i):
            close = source.partner[i] + 1
            yield self._make("cast", i, close, "", f"{source.code(i, close)} removed")
        elif text == "(" and source.tokens[i - 1].kind == "name":
            if source.tokens[i - 1].text not in (*_CONTROL, "sizeof"):
                yield from self._swaps(i)
        elif text == "{" and self._is_initializer(i):
            yield from self._swaps(i)

    def _is_same_by_type(self, i: int, new: str) -> bool:
        """Whether an equality with the last of an enumeration becomes an order towards it."""
        tokens = self.source.tokens
        name, behind = tokens[i + 1].text, tokens[i + 2].text
        if name not in self.enums or behind not in (")", "&&", "||", ";", ",", "?", ":"):
            return False
        ordered = (tokens[i].text, new) in (("==", ">="), ("!=", "<"))
        return ordered and name == self.enums[name][-1]

    def _is_initializer(self, i: int) -> bool:
        """Whether the brace at i opens a list of values, a compound literal's too."""
        source, before = self.source, self.source.tokens[i - 1].text
        if before != ")":
            return before in ("=", "{", ",", "]")
        opened = source.partner[i - 1]
        return source.is_type(opened + 2) or source.is_type(opened + 1)

    def _swaps(self, i: int) -> Iterator[Mutant]:
        """Neighbouring arguments, or elements of an initializer."""
        source = self.source
        parts = source.split(i + 1, source.partner[i])
        parts = [p for p in parts if p[1] > p[0]]  # behind a last comma there is nothing
        for (a, b), (c, d) in pairwise(parts):
            if source.tokens[a].text == "." or source.tokens[a].text == "[":
                continue  # designated
            left, right = source.code(a, b), source.code(c, d)
            yield self._make("swap", a, d, f"{right}, {left}")

    def _choice(self, i: int) -> Iterator[Mutant]:
        """a ? b : c becomes a ? c : b."""
        source = self.source
        colon = self._end_of_choice(i + 1)
        end = self._end_of_choice(colon + 1)
        first, second = source.code(i + 1, colon), source.code(colon + 1, end)
        yield self._make("choice", i + 1, end, f"({second}) : ({first})")

    def _end_of_choice(self, i: int) -> int:
        """The colon, comma, semicolon or bracket behind a branch that begins at i."""
        inner = 0
        while True:
            i = self.source.until(i, ("?", ":", ",", ";"))
            text = self.source.tokens[i].text
            if text == "?":
                inner += 1
            elif text != ":" or inner == 0:
                return i
            else:
                inner -= 1
            i += 1

    def _number(self, i: int) -> Iterator[Mutant]:
        text = self.source.tokens[i].text
        match = re.fullmatch(r"(0[xX][0-9a-fA-F]+|\d+)([uUlL]*)", text)
        assert match
        value = int(match[1], 0)
        for new in dict.fromkeys((value + 1, value - 1, 0, 1)):
            if new != value:
                shown = f"{new}{match[2]}" if new >= 0 else f"({new})"
                yield self._make("constant", i, i + 1, shown)

    def _name(self, i: int) -> Iterator[Mutant]:
        text = self.source.tokens[i].text
        if text in ("true", "false"):
            yield self._make("constant", i, i + 1, "false" if text == "true" else "true")
        elif text in self.enums:
            others = self.enums[text]
            at = others.index(text)
            for new in dict.fromkeys((others[at - 1], others[(at + 1) % len(others)])):
                yield self._make("enumerator", i, i + 1, new)
        elif re.fullmatch(r"[A-Z][A-Z0-9_]+", text) and self.source.tokens[i + 1].text != "(":
            more = () if text.endswith("_MAX") and "INT" in text else (f"({text} + 1)",)
            for new in (f"({text} - 1)", *more):
                yield self._make("constant", i, i + 1, new)
        elif text in ("if", "while"):
            yield from self._condition(i + 1, self.source.partner[i + 1])
        elif text == "for":
            parts = self._for_parts(i + 1)
            if parts[1][1] > parts[1][0]:
                yield from self._condition(parts[1][0] - 1, parts[1][1])
            if parts[2][1] > parts[2][0]:
                yield self._make("deletion", *parts[2], "", "step removed")
        elif text == "return" and self.source.tokens[i + 1].text != ";":
            end = self.source.until(i + 1, (";",))
            function = self._function
            if function and not function.type.startswith("struct"):
                for new in ("0", "1"):
                    yield self._make("return", i + 1, end, new)

    def _for_parts(self, i: int) -> list[tuple[int, int]]:
        source, parts, at = self.source, [], i + 1
        for _ in range(2):
            end = source.until(at, (";",))
            parts.append((at, end))
            at = end + 1
        return [*parts, (at, source.partner[i])]

    def _condition(self, before: int, close: int) -> Iterator[Mutant]:
        code = self.source.code(before + 1, close)
        yield self._make("condition", before + 1, close, f"!({code})")
        yield self._make("condition", before + 1, close, f"(({code}), true)", "condition -> true")
        yield self._make("condition", before + 1, close, f"(({code}), false)", "condition -> false")

    def _statements(self, begin: int, end: int) -> Iterator[Mutant]:
        """Statements deleted, initial values set to zero."""
        source, i = self.source, begin
        while i < end:
            text = source.tokens[i].text
            if text in ("{", "}", ";", "else", "do"):
                i += 1
            elif text in ("if", "while", "for", "switch"):
                if text == "for" and self._is_declaration(i + 2):
                    yield from self._initial_values(i + 2, source.until(i + 2, (";",)))
                i = source.partner[i + 1] + 1
            elif text in ("case", "default"):
                i = source.until(i, (":",)) + 1
            else:
                stop = source.until(i, (";",))
                if self._is_declaration(i):
                    yield from self._initial_values(i, stop)
                elif text != "return" or stop == i + 1:
                    yield self._make("deletion", i, stop, "", f"{self._short(i, stop)} removed")
                i = stop + 1

    def _short(self, begin: int, end: int) -> str:
        return " ".join(self.source.code(begin, end).split())

    def _is_declaration(self, i: int) -> bool:
        tokens = self.source.tokens
        if tokens[i].text in ("const", "static", "struct", "enum", "union"):
            return True
        return self.source.is_type(i) and tokens[i + 1].text != "("

    def _initial_values(self, begin: int, end: int) -> Iterator[Mutant]:
        source = self.source
        for a, b in source.split(begin, end):
            at = source.until(a, ("=", ",", ";"))
            if at < b and source.tokens[at].text == "=" and source.tokens[at + 1].text != "{":
                for new in ("0", "1"):
                    yield self._make("initial value", at + 1, b, new)


def enumerations(texts: list[str]) -> dict[str, tuple[str, ...]]:
    """The enumerators of all sources, each with all of its enumeration; the sentinel too."""
    found: dict[str, tuple[str, ...]] = {}
    for text in texts:
        source = Source(text)
        for i, token in enumerate(source.tokens):
            if token.text != "enum":
                continue
            brace = i + 1 if source.tokens[i + 1].text == "{" else i + 2
            if source.tokens[brace].text == "{":
                parts = source.split(brace + 1, source.partner[brace])
                names = tuple(source.tokens[a].text for a, b in parts if b > a)
                found.update(dict.fromkeys(names, names))
    return found
