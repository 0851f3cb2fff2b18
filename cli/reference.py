"""The page ``docs/cli.md``, written from the commands: ``python -m marcha.cli.reference > docs/cli.md``."""

from __future__ import annotations

import sys

from .app import EPILOGUE, build

HEAD = """# The command line

This page is written by `python -m marcha.cli.reference`; a test keeps it true.

`--json` on every command prints exactly one JSON object on standard output (also when it fails:
`{"error": …, "exit_code": …}`); messages and progress go to standard error. Colour and progress bars appear
only on a terminal, and `NO_COLOR` is respected. An expected failure is one line,
`marcha: FILE: what is wrong; what to do`; a traceback is a bug: please report it.

Moments (`--from`, `--to`, `--start`, `--end`) are `12.5`, `12.5s`, `1m`, `500ms` or `250000ns` after the
recording's start, or `@1700000000000000000`, nanoseconds of its own clock. Ranges are half open.

Outputs appear whole or not at all and are never replaced without `--force`. A process that is killed leaves
at most one hidden `.NAME.PID.part` beside the output; the next run that writes the same output removes it.
"""


def page() -> str:
    """Return the page as Markdown."""
    program, sys.argv[0] = sys.argv[0], "marcha"  # cyclopts names nested commands after the running program
    try:
        body = build().generate_docs()
    finally:
        sys.argv[0] = program
    _, _, commands = body.partition("\n## ")
    exits = " ".join(EPILOGUE.split())
    return (
        "\n".join(line.rstrip() for line in f"{HEAD}\n{exits}\n\n## {commands}".splitlines()).rstrip() + "\n"
    )


if __name__ == "__main__":
    print(page(), end="")
