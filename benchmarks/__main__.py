"""Print the benchmark table: ``python -m benchmarks [--scale 0.1] [--only recording] [--json FILE]``.

Figures are ratios against a peer in the same run: machines differ, ratios much less. ``--scale`` shrinks
the inputs for a quick look; the targets are promised at scale 1.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from dataclasses import asdict
from pathlib import Path

from . import Row

MODULES = (
    "recording",
    "export",
    "ingest",
    "replay",
    "engine",
    "indoor",
    "phone",
    "foot_consistency",
    "phone_consistency",
    "joint",
    "startup",
    "viz",
    "page",
    "study",
    "limits",
)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _table(rows: list[Row]) -> str:
    head = ("what", "ours", "unit", "peer", "theirs", "ratio", "target", "met")
    cells = []
    for r in rows:
        numbers = (_number(r.ours), r.unit, r.peer, _number(r.theirs), _number(r.ratio))
        cells.append((r.name, *numbers, r.target, "yes" if r.met else "NO"))
    widths = [max(len(row[i]) for row in [head, *cells]) for i in range(len(head))]
    lines = [head, tuple("-" * w for w in widths), *cells]
    return "\n".join(
        "| " + " | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) + " |" for line in lines
    )


def main() -> int:
    """Run the chosen benchmarks and print one Markdown table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="size of the inputs, 1 = as promised")
    parser.add_argument("--only", action="append", choices=MODULES, help="one group; repeatable")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    args = parser.parse_args()
    print(f"{platform.python_implementation()} {platform.python_version()}, {os.cpu_count()} cores\n")
    rows: list[Row] = []
    for name in args.only or MODULES:
        print(f"{name} …", file=sys.stderr, flush=True)
        rows += importlib.import_module(f".{name}", __package__).rows(args.scale)
    print(_table(rows))
    if args.json:
        args.json.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n", encoding="utf-8")
    return 0 if all(r.met for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
