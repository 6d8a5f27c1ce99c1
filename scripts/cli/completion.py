"""`headway completion`: what makes a shell complete commands, options and files."""

from __future__ import annotations

from typing import Literal

from headway.cli.failure import ExitCode

# After cyclopts' own script. bash: a folder gets its slash, and no blank after it. zsh: the script
# is made for a file in $fpath; with this it can be sourced as well.
MORE = {
    "bash": "complete -o filenames -F _headway headway\n",
    "zsh": "compdef _cyclopts_headway headway\n",
    "fish": "",
}


def completion(shell: Literal["bash", "zsh", "fish"], /) -> int:
    """Prints a script for a shell that completes the commands, options and files of `headway`.

    One line in the shell's start-up file makes use of it.

    Example: in `~/.bashrc`, in `~/.zshrc` after compinit, in `~/.config/fish/config.fish`.

        source <(headway completion bash)
        source <(headway completion zsh)
        headway completion fish | source

    Parameters
    ----------
    shell
        Which one: bash, zsh or fish.
    """
    from headway.cli.main import make_app

    print(make_app().generate_completion(shell=shell) + MORE[shell], end="")
    return ExitCode.DONE
