"""Folders of CSV or Parquet: one table a channel, with a sidecar that says what every column is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import closing
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import polars as pl

from ..recording import SCHEMAS, Channel, Recording
from ..recording.annotations import EVENT
from ..recording.events import COLUMNS as EVENT_COLUMNS
from ..recording.events import events_text, sidecar, to_events
from ..recording.selection import Selection, selected_topics, within
from ..recording.threads import Prefetch
from .facts import pretty
from .folder import MARKER, whole_folder

EVENTS, EVENTS_JSON = "events.tsv", "events.json"
README = "README.txt"
COMMON_COLUMNS = {
    "t_ns": "ns, time that the row speaks of",
    "t_log_ns": "ns, time when the row was known (equal for raw data)",
}


class TableExporter:
    """What CSV and Parquet have in common; a subclass writes one stream of tables to one file."""

    name: ClassVar[str]
    title: ClassVar[str]
    suffix: ClassVar[str] = ""
    file_suffix: ClassVar[str]
    Options: ClassVar[type[msgspec.Struct]] = Selection

    @abstractmethod
    def write(self, stream: _Stream, file: Path, about: dict[str, str]) -> None:
        """Write ``stream`` to ``file`` with bounded memory, and the facts ``about`` it where it can."""

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return nothing: tables hold every value, and the sidecar what is said of them."""
        selected_topics(rec, options)
        return []

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write a folder; see :class:`marcha.export.Exporter`."""
        topics = [t for t in selected_topics(rec, options) if rec.channels[t].schema != EVENT]
        with whole_folder(path, overwrite=overwrite) as folder:
            names = _file_names(topics, self.file_suffix)
            entries = []
            for topic in topics:
                channel = rec.channels[topic]
                about = {
                    "topic": topic,
                    "schema": channel.schema,
                    "frame_id": channel.frame_id,
                    "start_ns": str(rec.start_ns),
                    **{f"unit.{c}": meaning(channel.schema, c)["unit"] for c in _columns(channel)},
                }
                rows = self._write_channel(_Stream(rec, topic, options), folder / names[topic], about)
                entries.append(_describe(channel, names[topic], rows))
            written = [names[topic] for topic in topics]
            events = _events(rec, options)
            if events.height:
                (folder / EVENTS).write_text(events_text(events), encoding="utf-8", newline="\n")
                (folder / EVENTS_JSON).write_bytes(pretty(sidecar(rec.metadata)))
                written += [EVENTS, EVENTS_JSON]
            attached = _attachments(rec, folder)
            document = {
                "source": rec.path.name,
                "start_ns": rec.start_ns,
                "end_ns": rec.end_ns,
                "selection": msgspec.to_builtins(options),
                "channels": entries,
                "metadata": rec.metadata,
                "attachments": attached,
            }
            encoded = msgspec.json.format(msgspec.json.encode(document), indent=2)
            (folder / MARKER).write_bytes(encoded + b"\n")
            (folder / README).write_text(
                _readme(rec, entries, bool(events.height), attached), encoding="utf-8"
            )
            written += [*attached, MARKER, README]
        return [path / name for name in written]

    def _write_channel(self, stream: _Stream, file: Path, about: dict[str, str]) -> int:
        """Write one channel, return its rows; a full disk becomes an ``OSError``, whatever Polars says."""
        try:
            with closing(stream):
                self.write(stream, file, about)
        except (OSError, pl.exceptions.ComputeError) as error:
            if stream.failure is not None:
                raise stream.failure from None
            if isinstance(error, OSError) or "os error" in str(error):
                raise OSError(" ".join(str(error).split())) from None
            raise
        return stream.rows


class CsvExporter(TableExporter):
    """Comma-separated text, UTF-8, a header line, numbers with every digit that they have."""

    name = "csv"
    title = "folder of CSV files, one a channel, units in channels.json, events.tsv (spreadsheets, R, MATLAB)"
    file_suffix = ".csv"

    def write(self, stream: _Stream, file: Path, about: dict[str, str]) -> None:
        """Write one CSV file; lists and structs become JSON text in one cell."""
        with file.open("wb") as out:  # window by window: a lazy sink keeps half a megabyte of every call
            for number, table in enumerate(stream.tables()):
                nested = [name for name, dtype in table.schema.items() if dtype.is_nested()]
                cells = table.with_columns(pl.col(n).map_elements(_json_cell, pl.String) for n in nested)
                cells.write_csv(out, include_header=number == 0)


class ParquetExporter(TableExporter):
    """Parquet with topic, schema and frame in each file's own metadata.

    Snappy: read everywhere, and written in half the time of zstd, which makes files of noisy readings 10 to 20 %
    smaller.
    """

    name = "parquet"
    title = "folder of Parquet files, one a channel, with units in channels.json (Polars, pandas, DuckDB, R)"
    file_suffix = ".parquet"

    def write(self, stream: _Stream, file: Path, about: dict[str, str]) -> None:
        """Write one Parquet file."""
        stream.frame.sink_parquet(file, compression="snappy", metadata=about)


def _json_cell(value: Any) -> str:
    plain = value.to_list() if isinstance(value, pl.Series) else value
    return msgspec.json.encode(plain).decode()


class _Stream:
    """A channel as a stream of its windows, each read while the one before is written.

    Attributes
    ----------
    rows : int
        Rows that have passed.
    failure : BaseException or None
        Why the recording could not be read on: Polars would only say that something failed.
    """

    def __init__(self, rec: Recording, topic: str, options: Selection) -> None:
        self._tables = Prefetch(_tables(rec, topic, options), "export")
        first = next(self._tables, None)
        if first is None:
            first = rec.table(topic, start_ns=0, end_ns=0, log_time=True)
        self._first = first
        self.rows = 0
        self.failure: BaseException | None = None

    def close(self) -> None:
        """Read no more."""
        self._tables.close()

    @property
    def frame(self) -> pl.LazyFrame:
        """The windows as a lazy frame, which can be read once."""
        from polars.io.plugins import register_io_source

        return register_io_source(self._source, schema=dict(self._first.schema))

    def tables(self) -> Iterator[pl.DataFrame]:
        """Yield the windows; the first one is there even where it is empty."""
        schema = self._first.schema
        try:
            for table in chain([self._first], self._tables):
                self.rows += table.height
                yield table.select(pl.col(name).cast(dtype) for name, dtype in schema.items())
        except Exception as error:
            self.failure = error
            raise

    def _source(
        self, columns: list[str] | None, predicate: pl.Expr | None, n_rows: int | None, batch_size: int | None
    ) -> Iterator[pl.DataFrame]:
        schema = self._first.schema
        try:
            for table in chain([self._first], self._tables):
                self.rows += table.height
                yield table.select(pl.col(name).cast(schema[name]) for name in columns or schema)
        except Exception as error:
            self.failure = error
            raise


def _tables(rec: Recording, topic: str, options: Selection) -> Iterator[pl.DataFrame]:
    for window in rec.windows([topic], start_ns=options.start_ns, end_ns=options.end_ns):
        if topic in window.tables:
            yield window.tables[topic]


def _file_names(topics: list[str], suffix: str) -> dict[str, str]:
    """Return a file name for each topic: its parts joined by ``_``, numbered where two would be the same."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for topic in topics:
        stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in topic.strip("/")) or "channel"
        stem = _short(stem if stem[0] != "." else f"_{stem}")
        names[topic] = free_path(stem, taken) + suffix
    return names


def _describe(channel: Channel, file: str, rows: int) -> dict[str, Any]:
    """Return what the sidecar says about a channel and every column of its file."""
    return {
        "file": file,
        "topic": channel.topic,
        "schema": channel.schema,
        "frame_id": channel.frame_id,
        "rows": rows,
        "columns": [{"name": name, **meaning(channel.schema, name)} for name in _columns(channel)],
        "metadata": dict(channel.metadata),
    }


def _columns(channel: Channel) -> list[str]:
    return [*COMMON_COLUMNS, *(c for c in channel.columns if c not in COMMON_COLUMNS)]


def meaning(schema: str, column: str) -> dict[str, str]:
    """Return unit and meaning of a column; in a schema whose columns carry names, the suffix decides."""
    if column in COMMON_COLUMNS:
        unit, _, doc = COMMON_COLUMNS[column].partition(", ")
        return {"unit": unit, "meaning": doc}
    registered = SCHEMAS.get(schema)
    if registered is None:
        return {"unit": "", "meaning": "as the schema of the recording says"}
    if registered.names:
        fits = [c for c in registered.columns if column.endswith(c.name)]
        best = max(fits, key=lambda c: len(c.name), default=None)
    else:
        best = next((c for c in registered.columns if c.name == column), None)
    return {"unit": best.unit, "meaning": best.doc} if best else {"unit": "", "meaning": ""}


def _events(rec: Recording, options: Selection) -> pl.DataFrame:
    return to_events(within(rec.annotations, options), rec.start_ns or 0)


def _attachments(rec: Recording, folder: Path) -> list[str]:
    """Copy the attachments into ``attachments/``; return their names in the folder. None can leave it."""
    written: list[str] = []
    taken: set[str] = set()
    for attachment in rec.attachments:
        parts = [p for p in attachment.name.replace("\\", "/").split("/") if p not in ("", ".", "..")]
        name = free_path("/".join(("attachments", *map(_short, parts or ["attachment"]))), taken)
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(rec.attachment(attachment.name))
        written.append(name)
    return written


def free_path(name: str, taken: set[str]) -> str:
    """Return a path that is no other's, nor the folder of another (``a`` and ``a/b``), and reserve both.

    File systems may take names that differ in case for one.
    """
    free, number = name, 1
    while free.lower() in taken or f"{free.lower()}/" in taken or any(f in taken for f in _folders(free)):
        number += 1
        blocked = next((f for f in _folders(name) if f in taken), name)  # the first folder that is a file
        free = f"{name[: len(blocked)]}_{number}{name[len(blocked) :]}"
    taken.add(free.lower())
    taken.update(f"{f}/" for f in _folders(free))
    return free


def _folders(name: str) -> list[str]:
    lower = name.lower()
    return [lower[:i] for i, c in enumerate(lower) if c == "/"]


def _short(name: str, most: int = 200) -> str:
    """Return a name that file systems take: without control characters, at most 200 bytes long."""
    name = "".join(c if c.isprintable() else "_" for c in name)
    if len(name.encode()) <= most:
        return name
    stem, dot, suffix = name.rpartition(".")
    suffix = dot + suffix if stem and len(suffix) <= 10 else ""
    kept = name.removesuffix(suffix).encode()[: most - len(suffix.encode()) - 9].decode("utf-8", "ignore")
    return f"{kept}_{blake2b(name.encode(), digest_size=4).hexdigest()}{suffix}"


def _readme(rec: Recording, entries: list[dict[str, Any]], events: bool, attached: list[str]) -> str:
    """Return the page that a person reads first."""
    lines = [
        f"Export of {rec.path.name}",
        "",
        "One table a channel. t_ns is the time that a row speaks of, t_log_ns the time when it was known,",
        "both in nanoseconds of the recording's clock. Vectors are in the frame named beside the channel;",
        f"quaternions have their real part first. {MARKER} says the same for programs.",
    ]
    for entry in entries:
        frame = f", frame {entry['frame_id']}" if entry["frame_id"] else ""
        lines += ["", f"{entry['file']}: {entry['topic']} ({entry['schema']}{frame}), {entry['rows']} rows"]
        lines += [f"  {c['name']:<14} [{c['unit']}] {c['meaning']}".rstrip() for c in entry["columns"]]
    if events:
        lines += ["", f"{EVENTS}: annotations, tab separated, as BIDS events"]
        lines += [f"  {name:<14} {meaning}" for name, meaning in EVENT_COLUMNS.items()]
    if attached:
        lines += ["", "attachments/: files that the recording carries", *(f"  {name}" for name in attached)]
    return "\n".join(lines) + "\n"
