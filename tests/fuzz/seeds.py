"""Sound inputs: a sample of every registered importer, recordings, tables of labels, and TOML files.

Samples come from the contract tests, which every importer inherits: a format that is registered and tested is
fuzzed without being named here.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import product
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha import ingest
from marcha.ingest import registry
from numpy.typing import NDArray

from ..contracts.exporter import example
from ..contracts.importer import ImporterContract

TESTS = Path(__file__).resolve().parents[1]
ROWS = (64, 120, 400)
"""Lines of a sample, more where the format needs more: what reads them right reads more of them right."""
BINARY_BYTES = (4096, 16384, 1 << 30)
"""Bytes of a sample that is not text, more where the format needs more."""
Rows = dict[str, NDArray[np.uint64]]
"""Topic to the hashes of its rows, sorted."""


@dataclass(frozen=True)
class Sample:
    """A sound log and what it converts to.

    Attributes
    ----------
    format : str
        Importer.
    name : str
        Of the contract test that it comes from.
    files : dict of str to bytes
        Path inside the sample's folder to content; side files and mappings too.
    main : str
        What is converted: a file, or a folder of them.
    options : dict of str to str
        Of the format; ``{folder}`` stands for where the files lie.
    rows : Rows
        What a sound conversion gives, times left out.
    """

    format: str
    name: str
    files: dict[str, bytes]
    main: str
    options: dict[str, str]
    rows: Rows = field(default_factory=dict)


@dataclass(frozen=True)
class Seeds:
    """All sound inputs: logs, recordings with their rows, tables of labels, configurations of studies."""

    samples: list[Sample]
    recordings: dict[str, bytes]
    rows: dict[str, Rows]
    labels: dict[str, bytes]
    studies: dict[str, bytes]


def hashes(table: pl.DataFrame) -> NDArray[np.uint64]:
    """Return a number for every row: equal rows have equal ones."""
    return np.sort(table.hash_rows(seed=7).to_numpy())


def rows_of(rec: mr.Recording, *, times: bool) -> Rows:
    """Return the rows of every channel that can be read."""
    found = {}
    for topic, channel in rec.channels.items():
        if channel.columns and channel.count:
            table = rec.table(topic, log_time=times)
            # What an importer computes may differ in its last bit where a row stands at another place.
            found[topic] = hashes(table if times else table.drop("t_ns").cast({pl.Float64: pl.Float32}))
    return found


def contracts() -> list[type[ImporterContract]]:
    """Return the contract tests of the registered importers."""
    for path in sorted((*TESTS.glob("test_import_*.py"), *TESTS.glob("test_ingest_*.py"))):
        importlib.import_module(f"tests.{path.stem}")
    found: list[type[ImporterContract]] = []
    waiting = list(ImporterContract.__subclasses__())
    while waiting:
        kind = waiting.pop(0)
        waiting += kind.__subclasses__()
        if hasattr(kind, "importer") and kind.importer.name in registry.importers():
            found.append(kind)
    return found


def without_sample() -> list[str]:
    """Return registered importers for which there is no contract test, and so no sample."""
    return sorted(set(registry.importers()) - {c.importer.name for c in contracts()})


def sample(contract: type[ImporterContract], folder: Path) -> Sample:
    """Write, read and convert the sample of one importer."""
    test = contract()
    folder.mkdir(parents=True)
    path = test.sample(folder)
    options = {k: str(v).replace(str(folder), "{folder}") for k, v in test.settings(folder).items()}
    files = {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }
    main = path.relative_to(folder).as_posix()
    whole = converted(Sample(test.importer.name, contract.__name__, files, main, options), folder / "whole")
    for rows, size in product(ROWS, BINARY_BYTES):
        short = {
            k: v[:size]
            if b"\x00" in v
            else v
            if k.endswith(".toml")
            else b"".join(v.splitlines(keepends=True)[:rows])
            for k, v in files.items()
        }
        # Too few where a file is of few long lines, or ends with what makes it whole.
        with contextlib.suppress(mr.MarchaError):
            found = converted(replace(whole, files=short), folder / f"short{rows}-{size}")
            if found.rows.keys() == whole.rows.keys():
                return found
    return whole


def converted(sample: Sample, folder: Path) -> Sample:
    """Return a sample with the rows that it converts to."""
    put(sample.files, folder)
    given = {k: v.replace("{folder}", str(folder)) for k, v in sample.options.items()}
    out = folder / "sound.mcap"
    ingest.convert(folder / sample.main, out, format=sample.format, options=given)
    with mr.open(out) as rec:
        return replace(sample, rows=rows_of(rec, times=False))


def put(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files into a folder."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def recordings(folder: Path) -> dict[str, bytes]:
    """Return sound recordings: of every kind of channel, and of a walk with estimates."""
    from marcha.ingest.simulate import simulate
    from marcha.replay import replay

    folder.mkdir(parents=True)
    found = {"example": example(folder / "example.mcap", 64).read_bytes()}
    log = simulate("straight", folder, seed=3, length_m=2).paths[0]
    log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[: ROWS[1]]))
    ingest.convert(log, folder / "walk.mcap")
    with mr.open(folder / "walk.mcap") as rec:
        replay(rec, ["foot.naive"], out=folder / "done.mcap")
    found["walk"] = (folder / "done.mcap").read_bytes()
    return found


def labels(folder: Path) -> dict[str, bytes]:
    """Return tables of labels in every format that is written, and one by hand."""
    from marcha.export import export
    from marcha.export.labels import WRITTEN

    folder.mkdir(parents=True)
    rec = mr.open(example(folder / "example.mcap", 600))
    found = {}
    for name in (*WRITTEN, "events"):
        for path in export(
            rec, name, folder / f"{name}{WRITTEN[name].suffix if name in WRITTEN else '.tsv'}"
        ):
            found[path.name] = path.read_bytes()
    found["table.csv"] = b"onset,duration,label\n" + b"".join(
        b"%d.5,1,turn %d\n" % (k, k) for k in range(1, 20)
    )
    return found


def studies() -> dict[str, bytes]:
    """Return the configurations that ship with marcha."""
    folder = resources.files("marcha.study") / "presets"
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name.endswith(".toml")}


def make(folder: Path) -> Seeds:
    """Return all sound inputs."""
    samples = [sample(c, folder / f"{k}-{c.__name__}") for k, c in enumerate(contracts())]
    data = recordings(folder / "recordings")
    rows = {}
    for name, content in data.items():
        path = folder / "recordings" / f"{name}.mcap"
        path.write_bytes(content)
        with mr.open(path) as rec:
            rows[name] = rows_of(rec, times=True)
    return Seeds(samples, data, rows, labels(folder / "labels"), studies())
