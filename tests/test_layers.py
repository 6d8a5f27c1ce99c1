"""Which package may import which: the one rule of the house."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

MAY_IMPORT = {
    "controller": {"controller", "models", "devices", "configs"},
    "models": {"models", "configs"},
    "devices": {"devices", "firmware", "configs"},
    "sim": {"sim", "controller", "models", "devices", "firmware", "configs"},
    "firmware": {"firmware"},
    "configs": {"configs"},
}


def imported(source: str, package: tuple[str, ...]) -> set[str]:
    """The folders of the house that `source` imports, by name.

    `package` is the dotted package that the source belongs to, ("headway", "sim") for sim/x.py:
    relative imports start there. `import headway` alone counts as "headway", and so does a
    relative import that leaves the house.
    """
    modules: set[tuple[str, ...]] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            modules |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            if node.level and not base:
                base = ("headway",)  # climbs past the prefix
            base += tuple(node.module.split(".")) if node.module else ()
            modules |= {(*base, alias.name) for alias in node.names}
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module"
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            modules.add(tuple(str(node.args[0].value).split(".")))
    return {(*m, "headway")[1] for m in modules if m[0] == "headway"}


def forbidden(folder: str, source: str, package: tuple[str, ...]) -> set[str]:
    return imported(source, package) - MAY_IMPORT[folder]


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_folder_imports_only_what_it_may(folder: str) -> None:
    files = sorted((ROOT / folder).rglob("*.py*"))
    files = [f for f in files if f.suffix in {".py", ".pyi"}]
    assert files
    breaches = {
        str(file.relative_to(ROOT)): found
        for file in files
        if (
            found := forbidden(
                folder, file.read_text(), ("headway", *file.relative_to(ROOT).parent.parts)
            )
        )
    }
    assert breaches == {}


@pytest.mark.parametrize(
    ("folder", "source", "found"),
    [
        ("controller", "import headway.sim.plant", {"sim"}),
        ("controller", "import headway.sim as s, numpy", {"sim"}),
        ("controller", "from headway import models, firmware", {"firmware"}),
        ("controller", "from ..sim import plant", {"sim"}),
        ("controller", "from .. import sim", {"sim"}),
        ("models", "def f():\n    from headway.controller.loop import Loop", {"controller"}),
        ("devices", "if TYPE_CHECKING:\n    from headway.controller import loop", {"controller"}),
        ("sim", "from headway.cli.main import main", {"cli"}),
        ("sim", "import importlib\nimportlib.import_module('headway.cli')", {"cli"}),
        ("firmware", "import headway", {"headway"}),
        ("configs", "from ...headway import cli", {"headway"}),
    ],
)
def test_breach_is_found(folder: str, source: str, found: set[str]) -> None:
    assert forbidden(folder, source, ("headway", folder)) == found


@pytest.mark.parametrize(
    ("folder", "source"),
    [
        ("controller", "from headway.models import parameters\nfrom . import gains"),
        ("devices", "from ..firmware import _core"),
        ("sim", "from headway import controller, devices, firmware, models"),
        ("models", "import numpy\nfrom sim import other_peoples"),
    ],
)
def test_allowed_passes(folder: str, source: str) -> None:
    assert forbidden(folder, source, ("headway", folder)) == set()


def test_relative_import_inside_a_subpackage() -> None:
    package = ("headway", "models", "arm2")
    assert forbidden("models", "from ..parameters import Parameter", package) == set()
    assert forbidden("models", "from ...sim import plant", package) == {"sim"}
