"""The type stubs name what the compiled modules have, no more and no less."""

import ast
from pathlib import Path
from types import ModuleType

import pytest

from headway.controller import _tick
from headway.devices import _tracks
from headway.firmware import _core
from headway.sim import _board

ROOT = Path(__file__).resolve().parent.parent


def stubbed(body: list[ast.stmt]) -> set[str]:
    names = set()
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
    return names - {"__init__"}


OPERATORS = {"__mul__", "__len__", "__iter__", "__getitem__", "__setitem__", "__delitem__"}


def public(thing: object) -> set[str]:
    names = {n for n in vars(thing) if not n.startswith("_")} | (OPERATORS & vars(thing).keys())
    return names - {"Iterator"}  # of a list's, made when the first one is gone through


@pytest.mark.parametrize(
    ("module", "stub"),
    [
        (_core, "firmware/_core.pyi"),
        (_board, "sim/_board.pyi"),
        (_tracks, "devices/_tracks.pyi"),
        (_tick, "controller/_tick.pyi"),
    ],
)
def test_stub_names(module: ModuleType, stub: str) -> None:
    body = ast.parse((ROOT / stub).read_text()).body
    assert stubbed(body) == public(module)
    classes = [node for node in body if isinstance(node, ast.ClassDef)]
    assert len(classes) > 0
    for node in classes:
        assert stubbed(node.body) == public(getattr(module, node.name)), node.name
