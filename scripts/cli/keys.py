"""`headway keys`: the keys by which a machine's devices and its controller know each other."""

from __future__ import annotations

from pathlib import Path

from headway.cli.changes import Changes, changed_config
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import key_folder


def keys(config: Path, /, *, keys: Path | None = None, overrides: Changes = None) -> int:
    """Draws the keys of a machine that do not exist yet: one for each device, one for their clocks.

    Each is a file that only its owner may read. A device gets its key when it is set up, over the
    programmer; the controller proves with it who it is. Who has a device's key can control that
    device, and read what is said to it if he has recorded it. Who has sync.key can tell boards that
    synchronize among themselves a wrong time; he moves nothing. To replace a key remove its file
    and set its device up anew. docs/security.md says what is promised and what is not.

    Example: for the two-link arm, before a plant or a board is set up.

        headway keys configs/arm2.yaml

    Parameters
    ----------
    config
        The YAML file of a machine.
    keys
        The folder to keep them in. Default: ~/.config/headway/keys/NAME.
    overrides
        Changes one key of the config; may be repeated.
    """
    from headway.devices.keys import SYNC, KeyFileError, draw_key, key_path, read_key

    checked = changed_config(config, list(overrides or []))
    folder = key_folder(checked, keys)
    names = [axis.joint for axis in checked.machine.boards]
    if SYNC in names:
        raise Failure(ExitCode.USAGE, f"a joint cannot be called {SYNC}, as its key would be")
    try:
        for name in (*names, SYNC):
            if key_path(folder, name).exists():
                read_key(folder, name)
                print(f"{key_path(folder, name)}: kept")
            else:
                print(f"{draw_key(folder, name)}: drawn")
    except KeyFileError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    return ExitCode.DONE
