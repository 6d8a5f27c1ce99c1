"""C source as tokens, with what the operators have to know about them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_PATTERN = re.compile(
    r"(?P<space>(?:\s|//[^\n]*|/\*.*?\*/)+)"
    r"|(?P<directive>\#(?:\\\n|[^\n])*)"
    r'|(?P<text>"(?:\\.|[^"\\])*"|\'(?:\\.|[^\'\\])*\')'
    r"|(?P<number>0[xX][0-9a-fA-F]+[uUlL]*|\d+[uUlL]*)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<symbol><<=|>>=|\.\.\.|<<|>>|<=|>=|==|!=|&&|\|\||\+\+|--|->|[-+*/%&|^]=|.)",
    re.DOTALL,
)
_PAIRS = {"(": ")", "[": "]", "{": "}"}
_TYPE = re.compile(r"(?:u?int\d+|size|ptrdiff)_t|int|char|bool|void|long|short|unsigned|signed")
_TAGS = ("struct", "enum", "union")
_QUALIFIERS = ("const", "static", "inline", "volatile", "_Noreturn")
KEYWORDS = ("return", "if", "while", "for", "switch", "case", "else", "do", "sizeof", "goto")


@dataclass(frozen=True)
class Token:
    """One token; `start` is its offset in the source."""

    kind: str
    text: str
    start: int

    @property
    def end(self) -> int:
        """Offset behind it."""
        return self.start + len(self.text)


@dataclass(frozen=True)
class Function:
    """A definition: indices of its name, of its body's braces, and its type as written."""

    name: str
    head: int
    open: int
    close: int
    type: str


@dataclass
class Source:
    """A file: its tokens, the partner of each bracket, its functions.

    Raises ValueError for brackets that do not match.
    """

    text: str
    tokens: list[Token] = field(init=False)
    partner: dict[int, int] = field(init=False)
    functions: list[Function] = field(init=False)

    def __post_init__(self) -> None:
        found = (
            m for m in _PATTERN.finditer(self.text) if m.lastgroup not in ("space", "directive")
        )
        self.tokens = [Token(str(m.lastgroup), m.group(), m.start()) for m in found]
        self._match_brackets()
        self._find_functions()

    def _match_brackets(self) -> None:
        self.partner = {}
        opened: list[int] = []
        for i, token in enumerate(self.tokens):
            if token.text in _PAIRS:
                opened.append(i)
            elif token.text in _PAIRS.values():
                if not opened or _PAIRS[self.tokens[opened[-1]].text] != token.text:
                    raise ValueError(f"line {self.line(i)}: unmatched {token.text}")
                self.partner[i] = opened.pop()
                self.partner[self.partner[i]] = i
        if opened:
            raise ValueError(f"line {self.line(opened[-1])}: unmatched bracket")

    def _find_functions(self) -> None:
        self.functions = []
        i = begin = 0
        while i < len(self.tokens):
            text = self.tokens[i].text
            if text == "{" and i > 0 and self.tokens[i - 1].text == ")":
                head = self.partner[i - 1] - 1
                words = [t.text for t in self.tokens[begin:head]]
                kept = [w for w in words if w not in _QUALIFIERS]
                name = self.tokens[head].text
                self.functions.append(Function(name, head, i, self.partner[i], " ".join(kept)))
                i = begin = self.partner[i]
                begin += 1
            elif text in _PAIRS:
                i = self.partner[i]
            elif text == ";":
                begin = i + 1
            i += 1

    def line(self, i: int) -> int:
        """The line of token i, from 1."""
        return self.text.count("\n", 0, self.tokens[i].start) + 1

    def head_line(self, function: Function) -> int:
        """The line on which a definition begins."""
        i = function.head
        while i > 0 and self.tokens[i - 1].text not in (";", "}"):
            i -= 1
        return self.line(i)

    def is_type(self, i: int) -> bool:
        """Whether token i is (the name of) a type."""
        if i > 0 and self.tokens[i - 1].text in _TAGS:
            return True
        return _TYPE.fullmatch(self.tokens[i].text) is not None

    def is_cast(self, i: int) -> bool:
        """Whether the bracket at i opens a cast: types alone, and an operand behind it."""
        if self.tokens[i].text != "(" or self._is_called(i):
            return False
        inside = range(i + 1, self.partner[i])
        words = all(
            self.is_type(k) or self.tokens[k].text in (*_TAGS, "const", "*") for k in inside
        )
        return words and len(inside) > 0 and self.tokens[self.partner[i] + 1].text != "{"

    def _is_called(self, i: int) -> bool:
        before = self.tokens[i - 1]
        return before.kind == "name" and (before.text not in KEYWORDS or before.text == "sizeof")

    def is_binary(self, i: int) -> bool:
        """Whether the symbol at i has an operand on its left."""
        before = self.tokens[i - 1]
        if before.kind == "number":
            return True
        if before.kind == "name":
            return before.text not in KEYWORDS and not self.is_type(i - 1)
        if before.text == ")":
            return not self.is_cast(self.partner[i - 1])
        return before.text in ("]", "++", "--")

    def split(self, begin: int, end: int) -> list[tuple[int, int]]:
        """Ranges of tokens between the commas of [begin, end), none if it is empty."""
        parts, at, i = [], begin, begin
        while i < end:
            if self.tokens[i].text == ",":
                parts.append((at, i))
                at = i + 1
            i = self.partner[i] + 1 if self.tokens[i].text in _PAIRS else i + 1
        return [*parts, (at, end)] if end > begin else []

    def code(self, begin: int, end: int) -> str:
        """The text of tokens [begin, end)."""
        return self.text[self.tokens[begin].start : self.tokens[end - 1].end]

    def until(self, i: int, stops: tuple[str, ...]) -> int:
        """The first token from i on, outside of brackets, that is one of `stops` or closes."""
        while i < len(self.tokens) - 1 and self.tokens[i].text not in (*stops, *_PAIRS.values()):
            i = self.partner[i] + 1 if self.tokens[i].text in _PAIRS else i + 1
        return i
