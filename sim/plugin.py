"""Loads the compiled engine plugin (plugin.c) into MuJoCo.

`import mujoco` calls this too, through the package's entry point in the group `mujoco.plugins`, so
MuJoCo's own tools open our models. MuJoCo is therefore imported where it is used.
"""

from __future__ import annotations

from pathlib import Path

import headway.sim


def load_plugin() -> None:
    """Registers the engine plugin `headway.servo`. Safe to call twice.

    The compiled plugin lies beside the package's other compiled files, wherever the build put
    them, so it is looked for along the package's path.
    """
    import mujoco

    for folder in headway.sim.__path__:
        plugin = Path(folder) / "headway_servo.so"
        if plugin.exists():
            mujoco.mj_loadPluginLibrary(str(plugin))
            return
    raise FileNotFoundError("headway_servo.so is not built: run scripts/setup")
