"""``marcha completion``: completion of commands, options and paths in the shell."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from .console import Heading, Outcome
from .options import DEFAULT, Common


def completion(
    shell: Literal["zsh", "bash", "fish", "powershell"] | None = None,
    /,
    *,
    install: bool = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Print the script that completes commands in your shell, or install it.

    For this shell only: source <(marcha completion bash)

    Parameters
    ----------
    shell : str
        Your shell; the one that is running without it.
    install : bool
        Write the script where your shell looks for it; bash also gets a line in ~/.bashrc.
    """
    from cyclopts.completion import ShellDetectionError, detect_shell

    from ..recording.errors import UsageError
    from .app import build

    try:
        chosen = shell or detect_shell()
    except ShellDetectionError:
        raise UsageError(
            "completion: cannot tell which shell is running; name it, for example bash"
        ) from None
    app = build()
    if not install:
        script = app.generate_completion(shell=chosen)
        return Outcome({"shell": chosen, "script": script}, [Heading(script)])
    path: Path = app.install_completion(shell=chosen)
    return Outcome(
        {"shell": chosen, "path": str(path)}, [Heading(f"wrote {path}; open a new {chosen} to use it")]
    )
