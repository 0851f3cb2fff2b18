"""Hash every output table of every foot estimator × detector on real walks: proof that nothing changed.

``python -m benchmarks.foot_hashes OUT.json`` converts each file of the data folder's ``foot/`` (named by
``MARCHA_DATA``, default ``../shared/data``) and replays it through the public interface only, so it runs on
any two commits; ``--against BEFORE.json`` compares and ends with 1 where a table differs. Estimators run with
their preset ``published`` where they have one: the settings of the publication stay what they were.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.algorithms import find
from marcha.ingest import convert
from marcha.recording import MarchaError
from marcha.replay import replay

ESTIMATORS = ("naive", "9iez", "9iez-mad", "9iez-kf", "15iez-zaru", "ukf", "rts")
DETECTORS = ("c1c2c3", "pitch", "shoe", "are", "mv", "mag")
VARIANTS = (
    *(f"foot.{e}[detector={d}]" for e in ESTIMATORS for d in DETECTORS),
    *(f"foot.{e}[cleaning=fill-burst,init_s=0.5]" for e in ("9iez", "rts")),
    "foot.9iez[preset=live,integration=euler]",
    "foot.9iez[preset=device,cleaning=none]",
    "foot.9iez[hupt=true,heading_aid=hdr,init_s=0.3]",
    "foot.15iez-zaru[hupt=true,heading_aid=ihde,heading_directions=8]",
    "foot.9iez-mad[zupt_turns=true]",
    "foot.9iez-kf[zupt_turns=true]",
)
FORMER = {"foot.9iez-kf": "zupt_turns=false"}
"""Defaults that have changed since the hashes were first taken."""
SKIPPED = ("_strideIndex_", "LICENSE")
SEPARATOR = "\x1f"


def table_hash(table: pl.DataFrame) -> str:
    """Return a hash of names, types and bits of a table's columns."""
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(table.columns):
        column = table[name]
        digest.update(f"{name}{SEPARATOR}{column.dtype}{SEPARATOR}".encode())
        digest.update(np.ascontiguousarray(column.to_numpy()).tobytes())
    return digest.hexdigest()


def published(variant: str) -> str:
    """Return the variant with the published settings, where its defaults have moved on."""
    name, _, inside = variant.removesuffix("]").partition("[")
    former = FORMER.get(name, "")
    if former and former.partition("=")[0] not in inside:
        inside = f"{inside},{former}"
    presets: Any = getattr(find(name), "presets", {})
    if "published" not in presets or "preset=" in inside:
        return f"{name}[{inside}]"
    return f"{name}[preset=published,{inside}]"


def hashes(folder: Path) -> dict[str, dict[str, str]]:
    """Return for each file the hash of every table: ``<topic>`` of the input, ``<variant> <topic>`` else."""
    result: dict[str, dict[str, str]] = {}
    files = sorted(p for p in folder.rglob("*") if p.suffix in (".csv", ".mat"))
    with tempfile.TemporaryDirectory() as scratch:
        for path in (p for p in files if not any(s in p.name for s in SKIPPED)):
            name = path.relative_to(folder).as_posix()
            target = Path(scratch, path.stem + ".mcap")
            try:
                convert(path, target, overwrite=True)
            except MarchaError as error:
                result[name] = {"refused": str(error).rpartition("/")[2]}
                continue
            result[name] = _recording_hashes(target)
            print(f"{name}: {len(result[name])} tables", file=sys.stderr)
    return result


def _recording_hashes(path: Path) -> dict[str, str]:
    rec = mr.open(path)
    topics = [t for t, c in rec.channels.items() if c.schema == "sensor_msgs/msg/Imu"]
    found = {topic: table_hash(rec.table(topic)) for topic in topics}
    asked = [f"v{i}={published(v)}" for i, v in enumerate(VARIANTS)]
    for run in replay(rec, asked, metrics=False).runs:
        variant = VARIANTS[int(run.run.partition("_")[0].removeprefix("v"))]
        for output, table in run.tables.items():
            found[f"{variant} {run.input} {output}"] = table_hash(table)
    return found


def differences(before: dict[str, dict[str, str]], after: dict[str, dict[str, str]]) -> list[str]:
    """Return the names of all tables that are not equal in both, ``<file>: <table>``."""
    names = sorted({(f, t) for side in (before, after) for f, tables in side.items() for t in tables})
    return [f"{f}: {t}" for f, t in names if before.get(f, {}).get(t) != after.get(f, {}).get(t)]


def main() -> int:
    """Run as a script."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("MARCHA_DATA", "../shared/data")))
    given = parser.parse_args()
    if not (given.data / "foot").is_dir():
        parser.error(f"{given.data / 'foot'}: no such folder; name the data by --data or MARCHA_DATA")
    found = hashes(given.data / "foot")
    given.out.write_text(json.dumps(found, indent=1, sort_keys=True))
    if given.against is None:
        return 0
    wrong = differences(json.loads(given.against.read_text()), found)
    for name in wrong:
        print(name)
    print(f"{sum(map(len, found.values()))} tables, {len(wrong)} differ")
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main())
