"""What every importer must keep: inherit :class:`ImporterContract` and set the two class attributes.

A plug-in's author writes::

    class TestMyFormat(ImporterContract):
        importer = MyFormat()

        def sample(self, folder):
            path = folder / "walk.txt"
            path.write_bytes(...)
            return path
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import polars as pl
import pytest
from marcha.ingest import Import, Importer, Report
from marcha.ingest.registry import make_options
from marcha.recording import SCHEMAS, MarchaError

#: Widest believable values, in the recording's units.
SI_RANGES = {"acc": 2500.0, "gyr": 80.0, "mag": 0.01, "pos": 1e5, "vel": 50.0, "quat": 1.0 + 1e-6}

#: Content that belongs to no format.
FOREIGN = {
    "empty": b"",
    "one byte": b"\x00",
    "prose": b"Walking is a sequence of steps.\nIt has two phases.\n" * 40,
    "binary": bytes(np.random.default_rng(7).integers(0, 256, 20_000, dtype=np.uint8)),
    "other table": b"name;size;colour\n" + b"chair;12;red\ntable;40;brown\n" * 50,
}


class ImporterContract:
    """Promises of :class:`marcha.ingest.Importer`, checked on a sample of the importer's own format.

    Attributes
    ----------
    importer : Importer
        The importer under test.
    options : mapping
        Options that reading the sample needs.
    sniffs : bool
        False for a format that is only chosen by name.
    """

    importer: ClassVar[Importer]
    options: ClassVar[Mapping[str, Any]] = {}
    sniffs: ClassVar[bool] = True

    def sample(self, folder: Path) -> Path:
        """Write a healthy recording of at least 400 rows that moves, and return its path."""
        raise NotImplementedError

    def settings(self, folder: Path) -> Mapping[str, Any]:
        """Return the options; override where they depend on a file."""
        return self.options

    def read(self, path: Path, folder: Path) -> tuple[Import, dict[str, pl.DataFrame], Report]:
        """Read everything; return the import, one table a topic, and the report."""
        options = make_options(self.importer, self.settings(folder))
        imported = self.importer.read([path], options)
        parts: dict[str, list[pl.DataFrame]] = {}
        for topic, table in imported.blocks():
            parts.setdefault(topic, []).append(table)
        return imported, {t: pl.concat(p) for t, p in parts.items()}, imported.report

    def head(self, path: Path) -> bytes:
        return b"" if path.is_dir() else path.read_bytes()[:65536]

    def test_is_an_importer(self) -> None:
        assert isinstance(self.importer, Importer)
        assert self.importer.name == self.importer.name.lower().strip()
        assert self.importer.title

    def test_sniffs_its_own(self, tmp_path: Path) -> None:
        path = self.sample(tmp_path)
        confidence = self.importer.sniff(self.head(path), path)
        assert (0.5 <= confidence <= 1.0) if self.sniffs else confidence == 0.0

    @pytest.mark.parametrize("content", FOREIGN)
    def test_does_not_sniff_others(self, tmp_path: Path, content: str) -> None:
        path = tmp_path / "unknown.dat"
        path.write_bytes(FOREIGN[content])
        assert self.importer.sniff(FOREIGN[content][:65536], path) < 0.3

    def test_does_not_sniff_an_empty_folder(self, tmp_path: Path) -> None:
        folder = tmp_path / "empty"
        folder.mkdir()
        assert self.importer.sniff(b"", folder) == 0.0

    def test_declares_what_it_delivers(self, tmp_path: Path) -> None:
        imported, tables, _ = self.read(self.sample(tmp_path), tmp_path)
        specs = {c.topic: c for c in imported.channels}
        assert len(specs) == len(imported.channels)
        assert tables
        assert set(tables) <= set(specs)
        for topic, table in tables.items():
            schema = SCHEMAS[specs[topic].schema]
            assert topic.startswith("/")
            assert table.columns[0] == "t_ns"
            if specs[topic].columns:
                assert set(table.columns[1:]) == set(specs[topic].columns)
            if not schema.names:
                assert set(table.columns[1:]) <= {c.name for c in schema.columns}

    def test_says_which_clock(self, tmp_path: Path) -> None:
        imported, _, _ = self.read(self.sample(tmp_path), tmp_path)
        assert imported.metadata["device"]["clock"] in ("device", "utc", "unix")

    def test_time_is_whole_nanoseconds_and_never_decreases(self, tmp_path: Path) -> None:
        _, tables, _ = self.read(self.sample(tmp_path), tmp_path)
        for table in tables.values():
            assert table.schema["t_ns"] == pl.Int64
            assert table["t_ns"].null_count() == 0
            assert table["t_ns"].is_sorted()

    def test_values_are_si(self, tmp_path: Path) -> None:
        _, tables, _ = self.read(self.sample(tmp_path), tmp_path)
        for table in tables.values():
            for column in table.columns[1:]:
                limit = SI_RANGES.get(column.split("_")[0])
                if limit is not None and table[column].dtype.is_float():
                    values = table[column].to_numpy()
                    assert np.abs(values[np.isfinite(values)]).max(initial=0.0) <= limit, column

    def test_rest_is_one_g(self, tmp_path: Path) -> None:
        """Somewhere in the sample the sensor is quiet, and there gravity is 1 g within 10 %."""
        _, tables, _ = self.read(self.sample(tmp_path), tmp_path)
        for table in tables.values():
            if "acc_x" not in table.columns:
                continue
            norm = np.linalg.norm(table.select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
            windows = norm[: len(norm) // 20 * 20].reshape(-1, 20)
            quietest = windows[np.argmin(windows.std(axis=1))]
            assert abs(quietest.mean() / 9.80665 - 1) < 0.1

    def test_rows_add_up(self, tmp_path: Path) -> None:
        _, tables, report = self.read(self.sample(tmp_path), tmp_path)
        assert report.rows_read == report.rows_kept + report.rows_dropped
        assert report.rows_repaired <= report.rows_kept
        assert 0 < max(len(t) for t in tables.values()) <= report.rows_kept

    def test_report_waits_for_the_end(self, tmp_path: Path) -> None:
        path = self.sample(tmp_path)
        imported = self.importer.read([path], make_options(self.importer, self.settings(tmp_path)))
        with pytest.raises(RuntimeError):
            _ = imported.report

    def test_is_deterministic(self, tmp_path: Path) -> None:
        path = self.sample(tmp_path)
        _, first, report = self.read(path, tmp_path)
        _, second, again = self.read(path, tmp_path)
        assert report == again
        assert first.keys() == second.keys()
        for topic, table in first.items():
            assert table.equals(second[topic], null_equal=True)

    def test_leaves_the_source_alone(self, tmp_path: Path) -> None:
        path = self.sample(tmp_path)
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        before = [hashlib.blake2b(f.read_bytes()).digest() for f in files]
        self.read(path, tmp_path)
        assert [hashlib.blake2b(f.read_bytes()).digest() for f in files] == before

    @pytest.mark.parametrize("content", FOREIGN)
    def test_garbage_is_one_line(self, tmp_path: Path, content: str) -> None:
        """The sample's name with other content: one line that names the file, never a traceback."""
        path = self.sample(tmp_path)
        if path.is_dir():
            pytest.skip("a folder of files: its files are garbage in their own tests")
        path.write_bytes(FOREIGN[content])
        with pytest.raises(MarchaError) as caught:
            self.read(path, tmp_path)
        assert path.name in str(caught.value)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("share", [0.1, 0.35, 0.8, 0.999])
    def test_cut_short(self, tmp_path: Path, share: float) -> None:
        """A file cut anywhere gives what is whole, or one line that says why not."""
        path = self.sample(tmp_path)
        if path.is_dir():
            pytest.skip("a folder of files")
        _, whole, _ = self.read(path, tmp_path)
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])
        try:
            _, tables, report = self.read(path, tmp_path)
        except MarchaError as error:
            assert "\n" not in str(error)  # noqa: PT017 - failing is allowed, not demanded
            return
        assert report.rows_read == report.rows_kept + report.rows_dropped
        for topic, table in tables.items():
            assert len(table) <= len(whole[topic])
            assert table["t_ns"].is_sorted()

    def test_missing_file(self, tmp_path: Path) -> None:
        path = self.sample(tmp_path)
        gone = path.with_name(f"{path.stem}-gone{path.suffix}")
        with pytest.raises(MarchaError, match="gone"):
            self.read(gone, tmp_path)
