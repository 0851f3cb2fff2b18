"""Running the command line inside the test's own process."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marcha.cli import main


@dataclass(frozen=True)
class Ran:
    """What a command did: exit code, standard output, standard error."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> dict[str, Any]:
        """The one JSON object on standard output."""
        assert self.out.count("\n") == 1, self.out
        found = json.loads(self.out, parse_constant=lambda word: (_ for _ in ()).throw(ValueError(word)))
        assert isinstance(found, dict)
        return found

    @property
    def complaint(self) -> str:
        """The one line on standard error, beside warnings of plug-ins."""
        lines = [line for line in self.err.splitlines() if not line.startswith("marcha: warning: ")]
        assert len(lines) == 1, self.err
        assert lines[0].startswith("marcha: "), self.err
        return lines[0].removeprefix("marcha: ")


def marcha(*arguments: object) -> Ran:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(a) for a in arguments])
    return Ran(code, out.getvalue(), err.getvalue())


def marcha_process(*arguments: object, code: str = "", cwd: Path | None = None) -> Ran:
    """Run a command in a process of its own; ``code`` runs there first."""
    program = f"import sys; {code}\nfrom marcha.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=120,
        check=False,
    )
    return Ran(done.returncode, done.stdout, done.stderr)
