"""Checks a config's tree against the schema; finds all mistakes, not only the first ones.

Pydantic looks at a section as a whole only when each of its keys is right, and never below a key
that it does not know. So what was found is mended, with the suggestion or an example, and the tree
is checked again. What is found then counts if nothing that was put in has a part in it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from pydantic import ValidationError

from headway.configs.mistakes.examples import example
from headway.configs.mistakes.explain import broken_rule, missing, wrong
from headway.configs.mistakes.keys import at_path, best_first, keys
from headway.configs.mistakes.mistake import KeyPath, Mistake, Place
from headway.configs.mistakes.source import UNKNOWABLE
from headway.configs.mistakes.suggest import Suggestion, suggest
from headway.configs.mistakes.tree import Row, Table, at, changed, has, places_at, without
from headway.configs.schema import Config

ROUNDS_MAX = 4
EXPLAINED_MAX = 100  # mistakes of a round; those beyond are only counted
UNKNOWN, MISSING, RULE = "extra_forbidden", "missing", "value_error"  # pydantic's names
TOLD = "told"  # in place of pydantic's name: the value is told to be wrong already


@dataclass(frozen=True)
class _Problem:
    kind: str  # pydantic's name for it
    path: KeyPath
    message: str  # pydantic's, or of a section's own check


def check(tree: Table, source: Place) -> tuple[Config | None, list[Mistake]]:
    """The config, or what is wrong with it. `source` is the file."""
    search = _Search(tree, source)
    for _ in range(ROUNDS_MAX):
        try:
            config = Config.model_validate(search.tree)
        except ValidationError as error:
            if not search.look(_problems(search.tree, error)):
                break
        else:
            return (config if search.tree is tree else None), search.mistakes
    return None, search.mistakes


def _problems(tree: Table, error: ValidationError) -> list[_Problem]:
    """One for each value, the deepest: where a number or a list may stand, pydantic tells both."""
    found = []
    for problem in error.errors(include_url=False, include_context=False):
        kind, message = problem["type"], problem["msg"].removeprefix("Value error, ")
        path = _key_path(tree, problem["loc"], kind == MISSING)
        told = kind != UNKNOWN and at(tree, path) is UNKNOWABLE
        found.append(_Problem(TOLD if told else kind, path, message))
    deeper = {problem.path[:length] for problem in found for length in range(len(problem.path))}
    return [p for p in found if p.kind in (UNKNOWN, MISSING, RULE) or p.path not in deeper]


def _key_path(tree: Table, location: KeyPath, missing: bool) -> KeyPath:
    """A location without steps that are no keys: pydantic may add the names of a union's kinds."""
    path: KeyPath = ()
    for step in location:
        if has(at(tree, path), step):
            path = (*path, step)
    return (*path, location[-1]) if missing else path


class _Search:
    """A tree that gets better from round to round, and what was wrong with it."""

    def __init__(self, tree: Table, source: Place) -> None:
        self.tree, self.mistakes = tree, list[Mistake]()
        self._source = source
        self._told: set[tuple[KeyPath, str]] = set()
        self._examples: set[KeyPath] = set()  # values of ours
        self._renamed: set[KeyPath] = set()  # keys of ours

    def look(self, problems: list[_Problem]) -> bool:
        """Tells what is wrong and mends it; whether there is reason to look again."""
        problems.sort(key=lambda problem: self._place(problem.path).rank)
        problems, rest = problems[:EXPLAINED_MAX], problems[EXPLAINED_MAX:]
        unknown = {p.path: suggest(self.tree, p.path) for p in problems if p.kind == UNKNOWN}
        problems = [p for p in problems if not self._is_meant(p, unknown.values())] or problems
        for problem in problems:
            for path, text in self._words(problem, unknown):
                self._tell(path, text, problem.kind)
        self.mistakes += [Mistake(self._place(p.path), p.path, "is wrong") for p in rest]
        before = self.tree
        if not rest:
            self._mend(problems, unknown)
        return self.tree is not before

    def _is_meant(self, problem: _Problem, suggestions: Iterable[Suggestion]) -> bool:
        """Whether an unknown key stands for a missing one, or makes its section another kind."""
        if problem.kind != MISSING:
            return False
        section = problem.path[:-1]
        kind = best_first(at_path(self.tree, section) or {}, at(self.tree, section))[0]
        return problem.path[-1] not in keys(kind) or any(
            to.path == problem.path for to in suggestions
        )

    def _words(
        self, problem: _Problem, unknown: dict[KeyPath, Suggestion]
    ) -> list[tuple[KeyPath, str]]:
        path = problem.path
        if problem.kind == TOLD:
            return []
        if problem.kind == UNKNOWN:
            return [(path, f"unknown key; {unknown[path].text}")]
        if problem.kind == MISSING:
            return [(path, missing(self.tree, path))]
        if problem.kind == RULE:
            return broken_rule(self.tree, path, problem.message)
        return [(path, wrong(self.tree, path))]

    def _tell(self, path: KeyPath, text: str, kind: str) -> None:
        """Unless it is told, or something that we put in has a part in it."""
        words = set(re.findall(r"\w+", text)) if kind == RULE else set()
        ours = any(path[: len(put)] == put for put in self._examples) or any(
            put[-1] in words for put in self._examples | self._renamed
        )
        if not ours and (path, text) not in self._told:
            self._told.add((path, text))
            self.mistakes.append(Mistake(self._place(path, kind), path, text))

    def _place(self, path: KeyPath, kind: str = UNKNOWN) -> Place:
        """Of a key; or of its value, if that is what is wrong and is no section."""
        places, value = places_at(self.tree, path), at(self.tree, path)
        if places is None:
            return self._source
        return places[kind not in (UNKNOWN, MISSING) and not isinstance(value, Table | Row)]

    def _mend(self, problems: list[_Problem], unknown: dict[KeyPath, Suggestion]) -> None:
        for path, to in unknown.items():
            self._rename(path, to)
        for problem in problems:
            path = problem.path
            if path and problem.kind != UNKNOWN:
                self._put_example(path)

    def _rename(self, path: KeyPath, to: Suggestion) -> None:
        places = places_at(self.tree, path)
        self.tree = without(self.tree, path)
        if not to.path or not places:
            return
        known = at(self.tree, to.path)
        if to.value is None:
            self._put_example(to.path)
        elif isinstance(known, Table) and isinstance(to.value, Table):
            for key in to.value.keys() - known.keys():
                path = (*to.path, key)
                self.tree = changed(self.tree, path, to.value[key], to.value.places[key])
        elif isinstance(at(self.tree, to.path[:-1]), Table) and known is None:
            self.tree = changed(self.tree, to.path, to.value, places)
            self._renamed.add(to.path)

    def _put_example(self, path: KeyPath) -> None:
        value = example(self.tree, path)
        parent = at(self.tree, path[:-1])
        if value is not None and isinstance(parent, Table | Row):
            places = places_at(self.tree, path) or (self._source, self._source)
            self.tree = changed(self.tree, path, value, places)
            self._examples.add(path)
