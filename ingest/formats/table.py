"""Any table of text, with a TOML mapping that says what its columns mean (``docs/table-mapping.md``)."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..cells import Cells
from ..checks import SensorCheck, check_plausible
from ..contract import (
    ChannelSpec,
    CommonOptions,
    Import,
    ReportBuilder,
)
from ..mapping import (
    TICKS_NS,
    Mapping,
    Target,
    Topic,
    read_mapping,
    schema_name,
    targets,
)
from ..text import BLOCK_BYTES
from ..timestamps import MOST_NS, TimestampRepair, nanoseconds

#: Share of the full scale at which a 16-bit converter says its last count.
LAST_COUNT = 1 - 1.5 / 32768
#: Messages whose columns go missing together: one finding a topic.
TOGETHER = (
    "marcha_msgs/msg/OpticalMarkers",
    "geometry_msgs/msg/QuaternionStamped",
    "geometry_msgs/msg/PoseStamped",
)


class TableOptions(CommonOptions, frozen=True, kw_only=True):
    """The mapping file (``--map``).

    Attributes
    ----------
    mapping : str
        Path of the TOML file.
    """

    mapping: Annotated[str, msgspec.Meta(description="TOML file that says what the columns mean (--map)")]


class Table:
    """Importer ``table``: topics as the mapping says."""

    name: ClassVar[str] = "table"
    title: ClassVar[str] = (
        "any table of text (CSV, TSV, semicolons, blanks) with a TOML mapping of its columns"
    )
    Options = TableOptions
    folders: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """Never: what columns mean is not guessed; ``--map`` chooses this format."""
        return 0.0

    def read(self, paths: Sequence[Path], options: TableOptions) -> Import:
        """Read a file, or the files of a folder that the topics name."""
        map_file = Path(options.mapping)
        mapping = read_mapping(map_file)
        report = ReportBuilder()
        channels, blocks = open_table(paths[0], mapping, map_file, report)
        text = map_file.read_text(encoding="utf-8")
        metadata = {
            "device": {"clock": mapping.time.clock, **mapping.device},
            "mapping": {"file": map_file.name, "toml": text},
        }
        return Import(channels=channels, blocks=blocks, report=report, metadata=metadata)


def open_table(
    path: Path, mapping: Mapping, map_file: Path, report: ReportBuilder, *, beside: int = 1
) -> tuple[list[ChannelSpec], Iterator[tuple[str, pl.DataFrame]]]:
    """Return the channels of a mapped table, and the blocks that read it.

    Importers of text whose columns say themselves what they mean make a mapping of them and read it so.

    Parameters
    ----------
    path : Path
        The file, or the folder of the files that the topics name.
    mapping : Mapping
        What the columns mean.
    map_file : Path
        Where the mapping stands, for messages.
    report : ReportBuilder
        Takes what is found.
    beside : int
        So many tables are read side by side: all together hold as much as two that are read alone.

    Raises
    ------
    MarchaError
        The file is not as the mapping says.
    """
    channels, by_file = [], {}
    for i, topic in enumerate(mapping.topic):
        file = _file_of(path, topic, f"{map_file}: topic[{i}].file")
        parts = targets(map_file, mapping, i, topic)
        by_file.setdefault(file, []).append((f"{map_file}: topic[{i}]", topic, parts))
        names = tuple(t.name for t in parts)
        channels.append(ChannelSpec(topic.name, schema_name(topic), topic.frame, names, topic.metadata))
    files = [
        _File(
            map_file,
            Cells(f, mapping.layout, BLOCK_BYTES * 2 // max(2, beside)),
            mapping,
            topics,
            report,
            subject=f"{f.name}: " if len(by_file) > 1 else "",
        )
        for f, topics in by_file.items()
    ]
    return channels, _blocks(files, report)


def _file_of(path: Path, topic: Topic, key: str) -> Path:
    if not path.is_dir():
        return path
    files = sorted(p for p in path.rglob("*") if p.is_file())
    if topic.file is None:
        if len(files) == 1:
            return files[0]
        raise MarchaError(
            f"{key}: {path} is a folder of {len(files)} files; say which one {topic.name} is read from"
        )
    fits = [
        p
        for p in files
        if fnmatch.fnmatch(p.relative_to(path).as_posix(), topic.file) or p.name == topic.file
    ]
    if len(fits) != 1:
        how_many = "no file" if not fits else f"{len(fits)} files"
        raise MarchaError(f"{key}: {topic.file!r} fits {how_many} in {path}")
    return fits[0]


def _blocks(files: list[_File], report: ReportBuilder) -> Iterator[tuple[str, pl.DataFrame]]:
    for file in files:
        before = report.kept
        yield from file.blocks()
        if report.kept == before:
            reason = next((f" ({f.detail})" for f in report.build().findings if f.kind == "bad_row"), "")
            raise MarchaError(
                f"{file.path}: no row of it has a time and a value{reason}; does the mapping fit?"
            )


def _only(values: pl.Series, where: pl.Series) -> pl.Series:
    """Return ``values`` with null where ``where`` is not true."""
    return pl.select(pl.when(where).then(values)).to_series()


class _File:
    """One file and the topics that are read from it."""

    def __init__(
        self,
        map_file: Path,
        cells: Cells,
        mapping: Mapping,
        topics: list[tuple[str, Topic, list[Target]]],
        report: ReportBuilder,
        subject: str,
    ) -> None:
        self.path = cells.path
        self._report = report
        self._layout = mapping.layout
        self._time = mapping.time
        self._cells = cells
        self._time_at = (
            None
            if mapping.time.column is None
            else self._place(f"{map_file}: time.column", mapping.time.column)
        )
        self._topics = [
            (
                topic,
                [
                    (
                        f"{topic.name} {t.name}",
                        t,
                        None if t.column is None else self._place(f"{key}.columns.{t.name}", t.column),
                    )
                    for t in entries
                ],
            )
            for key, topic, entries in topics
        ]
        self._rows = 0
        self._last: dict[str, tuple[object, ...]] = {}
        time, period = mapping.time, mapping.time.rollover
        tick = 1 if period is None else TICKS_NS.get(time.unit, 1)
        if time.column is not None and time.rate_hz is not None:  # samples, which are no whole nanoseconds
            tick, period = 1, period and round(period * 1e9 / time.rate_hz)
        self._clock = TimestampRepair(report, tick_ns=tick, period=period, subject=subject, even=time.even)
        self._tick = tick
        self._checks = {
            topic.name: check for topic, entries in self._topics if (check := self._check(topic, entries))
        }

    def blocks(self) -> Iterator[tuple[str, pl.DataFrame]]:
        places = [p for _, entries in self._topics for _, _, p in entries if p is not None]
        if self._time_at is not None:
            places.append(self._time_at)
        frames = map(self._values, self._cells.rows(places, self._report))
        for frame in self._clock.stream(frames):
            yield from self._tables(frame)
        for check in self._checks.values():
            check.finish()

    def _place(self, key: str, column: str | int) -> int:
        place = self._cells.number(column)
        if place is None:
            have = ", ".join(self._cells.names) or f"{self._cells.width} columns"
            raise MarchaError(f"{key}: {self.path.name} has no column {column!r}; it has {have}")
        return place

    def _check(self, topic: Topic, entries: list[tuple[str, Target, int | None]]) -> SensorCheck | None:
        if schema_name(topic) != "sensor_msgs/msg/Imu":
            return None
        axes = [t for _, t, _ in entries if t.name[:4] in ("acc_", "gyr_")]
        limits = {
            t.name: (-t.full_scale * LAST_COUNT, t.full_scale * LAST_COUNT, f"{t.full_scale:.4g} in SI")
            for t in axes
            if t.full_scale is not None
        }
        return SensorCheck(self._report, topic.name, [t.name for t in axes], limits=limits)

    def _values(self, block: pl.DataFrame) -> pl.DataFrame:
        """Return ``t`` (ticks), ``line`` and columns ``<topic> <column>``, rows without time left out."""
        lines = block["line"]
        columns: dict[str, pl.Series] = {"t": self._ticks(block), "line": lines}
        for topic, entries in self._topics:
            many = schema_name(topic) in TOGETHER
            for name, target, place in entries:
                if place is not None:
                    text = block[f"c{place}"]
                    columns[name] = self._column(name, target, text, lines, topic.name if many else name)
        frame = pl.DataFrame(columns)
        most = MOST_NS // self._tick
        read = frame["t"].is_not_null()
        frame = frame.with_columns(t=pl.when(pl.col("t").is_between(-most, most)).then("t"))
        values = [c for c in frame.columns if c not in ("t", "line")]
        timeless = frame["t"].is_null()
        if timeless.any():
            first = int(timeless.arg_true()[0])
            text = "" if self._time_at is None else block[f"c{self._time_at}"][first]
            self._report.drop(
                "bad_row",
                f"{self.path.name}: {text!r} is {'beyond any clock' if read[first] else 'no time'} "
                f"({self._time.unit}); row dropped",
                count=int(timeless.sum()),
                line=lines[first],
            )
        void = ~timeless & (frame.select(pl.all_horizontal(pl.col(values).is_null())).to_series())
        if values and void.any():
            self._report.drop(
                "missing_cell",
                f"{self.path.name}: no value in any mapped column; row dropped",
                count=int(void.sum()),
                line=lines[int(void.arg_true()[0])],
                subject=f"{self.path.name} row",
            )
        return frame.filter(~(timeless | void) if values else ~timeless)

    def _ticks(self, block: pl.DataFrame) -> pl.Series:
        time = self._time
        if self._time_at is None:
            assert time.rate_hz is not None
            rows = np.arange(self._rows, self._rows + block.height, dtype=np.float64)
            self._rows += block.height
            return pl.Series(nanoseconds(rows, 1e9 / time.rate_hz))
        text = block[f"c{self._time_at}"].str.strip_chars()
        if time.unit == "datetime":
            if time.format is None:
                text = text.str.replace("T", " ", literal=True).str.strip_suffix("Z")
            form = time.format or "%Y-%m-%d %H:%M:%S%.f"
            try:
                return (
                    text.str.to_datetime(form, time_unit="ns", strict=False)
                    .dt.replace_time_zone(None)
                    .cast(pl.Int64)
                )
            except pl.exceptions.PolarsError as error:
                raise MarchaError(f"time.format: {form!r}: {str(error).splitlines()[0]}") from error
        if self._layout.decimal_comma:
            text = text.str.replace(",", ".", literal=True)
        if time.rate_hz is not None:
            count = text.cast(pl.Int64, strict=False).cast(pl.Float64)
            return (count * (1e9 / time.rate_hz)).round(0).cast(pl.Int64, strict=False)
        # Decimals keep nanoseconds that a float of epoch seconds loses; no product may leave them, or whole numbers.
        scale = TICKS_NS[time.unit] // self._tick
        most = (2**63 - 1) // scale
        return (text.cast(pl.Decimal(38, 9), strict=False).clip(-most, most) * scale).round(0).cast(pl.Int64)

    def _column(
        self, name: str, target: Target, text: pl.Series, lines: pl.Series, subject: str
    ) -> pl.Series:
        text = text.str.strip_chars()
        filled = text.is_not_null() & (text != "") & ~text.is_in(list(self._layout.missing))
        if not filled.all():
            self._report.note(
                "missing_cell",
                f"{name}: no value; NaN in the recording, or no message where a whole sensor is missing",
                count=int((~filled).sum()),
                line=lines[int((~filled).arg_true()[0])],
                subject=subject,
            )
        text = _only(text, filled)
        if target.kind == "text":
            return text
        if target.kind == "flag":
            low = text.str.to_lowercase()
            yes, no = low.is_in(["1", "1.0", "true", "yes"]), low.is_in(["0", "0.0", "false", "no"])
            return self._readable(name, text, _only(yes, yes | no), lines)
        dotted = text.str.replace(",", ".", literal=True)
        value = (dotted if self._layout.decimal_comma else text).cast(pl.Float64, strict=False)
        comma = (text.str.contains(r"^[+-]?\d+,\d+([eE][+-]?\d+)?$") & value.is_null()).fill_null(False)
        if comma.any():
            first = int(comma.arg_true()[0])
            self._report.repair(
                "decimal_comma",
                f"{name}: {text[first]!r} read as {dotted[first]}",
                count=int(comma.sum()),
                line=lines[first],
                subject=name,
            )
            value = value.zip_with(~comma, dotted.cast(pl.Float64, strict=False))
        sound = value.is_finite()
        if target.kind == "time":
            sound &= (value * target.factor + target.offset).abs() <= MOST_NS
        value = self._readable(name, text, _only(value, sound), lines)
        value = value * target.factor + target.offset
        return value.round(0).cast(pl.Int64) if target.kind == "time" else value

    def _readable(self, name: str, text: pl.Series, value: pl.Series, lines: pl.Series) -> pl.Series:
        bad = text.is_not_null() & value.is_null()
        if bad.any():
            first = int(bad.arg_true()[0])
            self._report.repair(
                "missing_cell",
                f"{name}: {text[first]!r} is not a value: taken as missing",
                count=int(bad.sum()),
                line=lines[first],
                subject=f"{name} unreadable",
            )
        return value

    def _tables(self, frame: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
        for topic, entries in self._topics:
            read = [name for name, _, place in entries if place is not None]
            has = frame.filter(pl.any_horizontal(pl.col(c).is_not_null() for c in read)) if read else frame
            table = has.select(
                "t_ns",
                "line",
                *(
                    (pl.lit(t.constant) if place is None else pl.col(name)).alias(t.name)
                    for name, t, place in entries
                ),
            )
            exact = [t.name for _, t, _ in entries if t.kind != "number"]
            if exact:
                table = table.drop_nulls(exact)
            numbers = [t.name for _, t, _ in entries if t.kind == "number"]
            table = table.with_columns(pl.col(numbers).cast(pl.Float64).fill_null(np.nan))
            if topic.only_changes:
                table = self._changes(topic, table)
            if not table.height:
                continue
            if topic.name in self._checks:
                self._watch(topic.name, table)
            else:
                columns = {c: table[c].to_numpy() for c in numbers}
                check_plausible(self._report, topic.name, columns, table["line"].to_numpy())
            yield topic.name, table.drop("line")

    def _changes(self, topic: Topic, table: pl.DataFrame) -> pl.DataFrame:
        if not table.height:
            return table
        data = table.drop("t_ns", "line")
        new = data.select(pl.any_horizontal(pl.all().ne_missing(pl.all().shift(1)))).to_series()
        new = new.to_numpy().copy()
        new[0] = data.row(0) != self._last.get(topic.name)
        self._last[topic.name] = data.row(-1)
        repeats = np.flatnonzero(~new)
        if repeats.size:
            self._report.note(
                "stale_repeat",
                f"{topic.name}: the same values as in the row before: no message (only_changes)",
                count=repeats.size,
                line=table["line"][int(repeats[0])],
                subject=topic.name,
            )
        return table.filter(pl.Series(new))

    def _watch(self, topic: str, table: pl.DataFrame) -> None:
        lines = table["line"].to_numpy()
        axes = [c for c in table.columns if c[:4] in ("acc_", "gyr_")]
        self._checks[topic].feed([table[c].to_numpy() for c in axes], lines)
        acc = [table[c].to_numpy() for c in axes if c.startswith("acc")]
        gyr = [table[c].to_numpy() for c in axes if c.startswith("gyr")]
        self._checks[topic].feed_si(acc, gyr, lines)
