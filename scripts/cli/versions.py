"""What a run's figures depend on besides its config and its seed."""

from __future__ import annotations

import importlib.metadata
import platform

PACKAGES = ("headway", "mujoco", "casadi", "osqp", "numpy", "pin")


def versions() -> dict[str, str]:
    """Version by name, of Python and of the packages that compute."""
    return {"python": platform.python_version()} | {
        name: importlib.metadata.version(name) for name in PACKAGES
    }
