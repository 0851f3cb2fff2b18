"""Motion-BIDS (BEP 029): the tracking systems of one recording of a dataset, its events, its derivatives.

A recording is all ``…_tracksys-*_motion.tsv`` of one subject, session, task and run. What marcha itself
exported comes back as the channels that it was; of other datasets, ``channels.tsv`` says what a column is.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import MarchaError, UsageError
from ...recording.event_table import read_events
from ...recording.events import bids_events
from ...recording.files import read_small
from ..contract import ChannelSpec, CommonOptions, Import, ReportBuilder
from ..optical import TimedTables, blocks_of, float_windows
from ..text import read_text, text_lines
from ..timestamps import nanoseconds, possible_rate
from ..units import conversion

_NAME = re.compile(
    r"(?P<head>sub-[0-9A-Za-z]+(_ses-[0-9A-Za-z]+)?_task-[0-9A-Za-z]+(_acq-[0-9A-Za-z]+)?)"
    r"_tracksys-(?P<system>[0-9A-Za-z]+)(?P<run>_run-[0-9]+)?(?P<tail>(_desc-[0-9A-Za-z]+)?)_motion\.tsv"
)
IMU, MAG = "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField"
POSE, POINT = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped"
ROTATION, VECTOR = "geometry_msgs/msg/QuaternionStamped", "geometry_msgs/msg/Vector3Stamped"
JOINTS, VALUES = "sensor_msgs/msg/JointState", "marcha_msgs/msg/NamedValues"
_GROUPS = {"ACCEL": "acc", "GYRO": "gyr", "MAGN": "mag", "POS": "pos", "VEL": "vel", "ORNT": "quat"}
_UNITS = {"acc": "m/s²", "gyr": "rad/s", "mag": "T", "pos": "m", "vel": "m/s"}
_KNOWN_AT = "t_log_ns"
Floats = NDArray[np.float64]


class BidsImportOptions(CommonOptions, frozen=True, kw_only=True):
    """Nothing of its own."""


class TableColumn(NamedTuple):
    """Where a column of a channel lies in the table: value · factor + offset."""

    place: int
    factor: float = 1.0
    offset: float = 0.0
    dtype: str = "Float64"


class Bids:
    """Importer ``bids``: one recording of a Motion-BIDS dataset."""

    name: ClassVar[str] = "bids"
    title: ClassVar[str] = "Motion-BIDS: the tracking systems of one recording, with events and derivatives"
    Options = BidsImportOptions
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """The name that BIDS demands, a table without a header, and the channels beside it."""
        if not _NAME.fullmatch(path.name) or not _beside(path, "channels.tsv").is_file():
            return 0.0
        first = head.split(b"\n", 1)[0].decode("utf-8", "replace").split("\t")
        return (
            1.0 if all(re.fullmatch(r"\s*(n/a|nan|[-+0-9.eE]+)\s*", c, re.IGNORECASE) for c in first) else 0.0
        )

    def chief(self, path: Path) -> Path:
        """Return the first tracking system of the recording that a table belongs to; raw before derivatives."""
        return _tables(path)[0]

    def read(self, paths: Sequence[Path], options: BidsImportOptions) -> Import:
        """Read all tracking systems of one recording."""
        for path in paths:
            if not _NAME.fullmatch(path.name):
                raise MarchaError(
                    f"{path}: not named as BIDS demands: sub-LABEL_task-LABEL_tracksys-LABEL_motion.tsv"
                )
        tables = _tables(paths[0])
        for path in paths[1:]:
            if path.resolve() not in {t.resolve() for t in tables}:
                raise UsageError(
                    f"{path}: another recording than {paths[0].name}; convert one at a time, or a folder of them"
                )
        report = ReportBuilder()
        root, facts = _own_facts(tables[0])
        systems = [_System(path, root, facts, report) for path in tables]
        specs: dict[str, ChannelSpec] = {}
        for system in systems:
            for spec in system.specs:
                if spec.topic in specs:
                    raise MarchaError(
                        f"{system.path}: {spec.topic} comes from another tracking system already"
                    )
                specs[spec.topic] = spec
        metadata = {k: dict(v) for k, v in facts.get("metadata", {}).items()}
        dated = any(s.utc for s in systems)
        metadata.setdefault(
            "device", {"clock": "utc" if dated else "device", "frames": "as the dataset has them"}
        )
        return Import(
            channels=list(specs.values()),
            blocks=(block for system in systems for block in system.blocks()),
            report=report,
            metadata=metadata,
            also_read=[p for s in systems for p in s.also_read] + list(_events(tables[0])),
            annotations=_annotations(tables[0], min(s.start_ns for s in systems)),
        )


class _System:
    """One tracking system: its channels, and where their columns lie in the table."""

    def __init__(self, path: Path, root: Path, facts: dict[str, Any], report: ReportBuilder) -> None:
        self.path, self._report = path, report
        self._about = _json(_beside(path, "motion.json"))
        self._channels = _channels(path)
        self.also_read = [
            _beside(path, n) for n in ("channels.tsv", "motion.json") if _beside(path, n).is_file()
        ]
        names = self._channels["name"].to_list()
        kinds = self._channels["type"].to_list()
        self._latency = kinds.index("LATENCY") if "LATENCY" in kinds else None
        self.start_ns, self.utc = int(facts.get("start_ns", 0)), False
        if not facts and (acquired_ns := _acquired(path, root)) is not None:
            self.start_ns, self.utc = acquired_ns, True
        stated = facts.get("columns", {}).get(path.name)
        if stated is not None and [s[0] for s in stated] == names[1:]:
            self._fields = _own_fields(stated)
            self.specs = _own_specs(self._fields, facts["channels"])
        else:
            self.specs, self._fields = _generic(path, self._channels)

    def blocks(self) -> Iterator[tuple[str, pl.DataFrame]]:
        """Yield the channels block by block, accounting for every row."""
        yield from blocks_of(self._windows(), self._report)

    def _windows(self) -> Iterator[TimedTables]:
        names = self._channels["name"].to_list()
        rate_hz = self._rate()
        first_ns, last_ns, count = None, 0, 0
        # A row may begin with n/a: the number that makes it a row is put before it.
        values_of = float_windows(self.path, self._pieces(len(names)), "\t", ["row", *names], self._report)
        for values, rows in values_of:
            t_ns, values, rows = self._times(values[:, 1:], rows)
            if not rows.size:
                continue
            first_ns = int(t_ns[0]) if first_ns is None else first_ns
            last_ns, count = int(t_ns[-1]), count + len(t_ns)
            yield t_ns, rows, [(spec.topic, self._table(spec.topic, values)) for spec in self.specs]
        if self._latency is not None and rate_hz is not None and first_ns is not None and count > 2:
            measured = (count - 1) * 1e9 / max(1, last_ns - first_ns)
            if abs(measured / rate_hz - 1.0) > 0.02:
                self._report.note(
                    "rate_doubt",
                    f"{self.path.name}: SamplingFrequency is {rate_hz:g} Hz, its LATENCY channel runs at "
                    f"{measured:.4g} Hz: the latter is used",
                )

    def _pieces(self, count: int) -> Iterator[tuple[int, list[str]]]:
        """Yield the table's lines with a number before each that is not blank."""
        for first_line, lines in text_lines(self.path):
            width = lines[0].count("\t") + 1 if first_line == 1 and lines[0] else count
            if width != count:
                raise MarchaError(
                    f"{self.path}, line 1: has {width} columns, {_beside(self.path, 'channels.tsv').name} lists "
                    f"{count}; both must agree"
                )
            yield first_line, [f"0\t{line}" if line.strip() else "" for line in lines]

    def _table(self, topic: str, values: Floats) -> pl.DataFrame:
        columns: dict[str, pl.Series] = {}
        for name, c in self._fields[topic].items():
            series = pl.Series(values[:, c.place] * c.factor + c.offset)
            if name.endswith("_ns"):
                series = pl.Series(nanoseconds(values[:, c.place], 1e9, self.start_ns))
            elif c.dtype != "Float64":
                series = series.cast(getattr(pl, c.dtype))
            columns[name] = series
        return pl.DataFrame(columns)

    def _rate(self) -> float | None:
        """Return the stated rate (Hz), None where there is none."""
        rate = self._about.get("SamplingFrequency")
        return float(min(rate, 1e300)) if isinstance(rate, int | float) and rate > 0 else None

    def _times(
        self, values: Floats, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64]]:
        """Return times (n,) of the rows that have one, those rows, and their lines."""
        if self._latency is None:
            rate_hz = self._rate()
            if rate_hz is None:
                raise MarchaError(
                    f"{self.path}: has no LATENCY channel, and {_beside(self.path, 'motion.json').name} no "
                    "SamplingFrequency above 0; state one of them"
                )
            possible_rate(rate_hz, self.path, "correct SamplingFrequency")
            return nanoseconds(rows - 1, 1e9 / rate_hz, self.start_ns), values, rows
        factor, _ = conversion(str(self._channels["units"][self._latency]), "ns")
        seconds = values[:, self._latency]
        finite = np.isfinite(seconds)
        if not finite.all():
            self._report.drop(
                "bad_row",
                "a row without a time in its LATENCY channel; dropped",
                count=int((~finite).sum()),
                line=int(rows[~finite][0]),
            )
            values, rows, seconds = values[finite], rows[finite], seconds[finite]
        return nanoseconds(seconds, factor, self.start_ns), values, rows


def _tables(path: Path) -> list[Path]:
    """Return the tables of the recording that one belongs to: raw, then those of derivatives."""
    match = _NAME.fullmatch(path.name)
    root = _root(path)
    if match is None:
        return [path]
    relative = path.parent.relative_to(root)
    if relative.parts[:1] == ("derivatives",):
        relative = Path(*relative.parts[2:])
    folders = [root / relative, *sorted(p / relative for p in (root / "derivatives").glob("*") if p.is_dir())]
    tables = []
    for folder in folders:
        for other in sorted(folder.glob("*_motion.tsv")) if folder.is_dir() else ():
            same = _NAME.fullmatch(other.name)
            if same and same["head"] == match["head"] and same["run"] == match["run"]:
                tables.append(other)
    return tables or [path]


def _root(path: Path) -> Path:
    """Return the dataset's folder: the topmost parent with a description, else the subject's parent."""
    parents = list(path.parents)
    described = [p for p in parents if (p / "dataset_description.json").is_file()]
    if described:
        return described[-1]
    return next((p.parent for p in parents if p.name.startswith("sub-")), path.parent)


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name.removesuffix("motion.tsv") + ending)


def _events(path: Path) -> Iterator[Path]:
    """Yield the tables of events that belong to the recording of a table."""
    match = _NAME.fullmatch(path.name)
    if match is not None:
        run = match["run"] or ""
        names = {f"{match['head']}{run}_events.tsv", _beside(path, "events.tsv").name}
        yield from (p for n in sorted(names) if (p := path.with_name(n)).is_file())


def _annotations(path: Path, start_ns: int) -> pl.DataFrame | None:
    """Return the events of a recording; those that marcha exported, and nobody changed, with every sign."""
    tables = [read_events(p, start_ns, tier="events") for p in _events(path)]
    if not tables:
        return None
    events = pl.concat(tables)
    match = _NAME.fullmatch(path.name)
    kept = _root(path) / "sourcedata" / f"{match['head']}{match['run'] or ''}_events.tsv" if match else path
    if not match or not kept.is_file():
        return events
    exact = read_events(kept, start_ns)
    same = bids_events(exact).with_columns(pl.Series("row", range(exact.height), dtype=pl.Int64))
    key = ["id", "tier", "start_ns", "end_ns", "label", "note", "source", "channel", "confidence"]
    rows = events.join(same.select(*key, "row"), on=key, how="left", nulls_equal=True, maintain_order="left")[
        "row"
    ]
    return pl.concat([exact[rows.drop_nulls().to_list()], events.filter(rows.is_null())])


def _own_facts(path: Path) -> tuple[Path, dict[str, Any]]:
    """Return the dataset's folder, and what marcha wrote of this recording when it exported it."""
    root, match = _root(path), _NAME.fullmatch(path.name)
    facts = (
        _json(root / "sourcedata" / "marcha.json").get(f"{match['head']}{match['run'] or ''}", {})
        if match
        else {}
    )
    return root, facts if {"channels", "columns", "start_ns"} <= set(facts) else {}


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content = json.loads(read_small(path))
    except ValueError as error:
        raise MarchaError(f"{path}: is not JSON: {error}") from None
    return content if isinstance(content, dict) else {}


def _channels(path: Path) -> pl.DataFrame:
    """Return ``channels.tsv``: ``name, component, type, tracked_point, units, reference_frame``."""
    beside = _beside(path, "channels.tsv")
    if not beside.is_file():
        raise MarchaError(f"{path}: has no {beside.name} beside it, which says what its columns are")
    rows = [line.split("\t") for line in read_text(beside).split("\n") if line.strip()]
    heads = [h.strip() for h in rows[0]] if rows else []
    for needed in ("name", "type", "units"):
        if needed not in heads:
            raise MarchaError(f"{beside}, line 1: has no column {needed}; BIDS demands name, type and units")
    for k, row in enumerate(rows[1:], 2):
        if len(row) != len(heads):
            raise MarchaError(f"{beside}, line {k}: has {len(row)} cells, its header {len(heads)}")
    if len(rows) < 2:
        raise MarchaError(f"{beside}: lists no channel")
    table = pl.DataFrame({h: [r[k].strip() for r in rows[1:]] for k, h in enumerate(heads)})
    missing = [
        pl.lit("n/a").alias(c) for c in ("component", "tracked_point", "reference_frame") if c not in heads
    ]
    return table.with_columns(*missing, pl.col("type").str.to_uppercase())


def _acquired(path: Path, root: Path) -> int | None:
    """Return the UTC time at which the recording of a table began, as ``scans.tsv`` states it."""
    for folder in path.parents:
        for scans in sorted(folder.glob("sub-*_scans.tsv")):
            rows = [line.split("\t") for line in read_text(scans).split("\n") if line.strip()]
            if not rows or not {"filename", "acq_time"} <= set(rows[0]):
                continue
            name, column = rows[0].index("filename"), rows[0].index("acq_time")
            for row in rows[1:]:
                if (
                    len(row) == len(rows[0])
                    and row[name].endswith(path.name)
                    and row[column] not in ("n/a", "")
                ):
                    return _instant(scans, row[column])
        if folder == root:
            break
    return None


def _instant(path: Path, text: str) -> int:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise MarchaError(f"{path}: acq_time {text!r} is no ISO 8601 time") from None
    since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def _own_fields(stated: Sequence[Sequence[str]]) -> dict[str, dict[str, TableColumn]]:
    fields: dict[str, dict[str, TableColumn]] = {}
    for k, (_, topic, column, dtype) in enumerate(stated, 1):
        fields.setdefault(topic, {})[column] = TableColumn(k, dtype=dtype)
    return fields


def _own_specs(fields: dict[str, dict[str, TableColumn]], channels: dict[str, Any]) -> list[ChannelSpec]:
    """Return the channels that were exported; one that lost its columns of text becomes named values."""
    specs = []
    for topic, columns in fields.items():
        about = channels[topic]
        own = [c for c in columns if c != _KNOWN_AT]
        if set(about["columns"]) <= set(own):
            specs.append(
                ChannelSpec(topic, about["schema"], about["frame_id"], tuple(own), about["metadata"])
            )
        else:
            numbers = tuple(c for c in own if not c.endswith("_ns"))
            specs.append(ChannelSpec(topic, VALUES, about["frame_id"], numbers, about["metadata"]))
            fields[topic] = {c: columns[c]._replace(dtype="Float64") for c in numbers}
    return specs


def _generic(
    path: Path, channels: pl.DataFrame
) -> tuple[list[ChannelSpec], dict[str, dict[str, TableColumn]]]:
    """Return the channels of another maker's table by type, component and tracked point."""
    match = _NAME.fullmatch(path.name)
    system = match["system"] if match else "motion"
    inertial = channels["type"].is_in(["ACCEL", "GYRO", "MAGN"]).any()
    points: dict[str, dict[str, TableColumn]] = {}
    joints: dict[str, TableColumn] = {}
    frames: dict[str, str] = {}
    for k, row in enumerate(channels.iter_rows(named=True)):
        if row["type"] == "LATENCY":
            continue
        point = row["tracked_point"] if row["tracked_point"] != "n/a" else row["name"]
        column, unit = _meaning(row)
        try:
            factor, offset = conversion(row["units"], unit) if unit else (1.0, 0.0)
        except UsageError as error:
            where = _beside(path, "channels.tsv")
            raise MarchaError(f"{where}, line {k + 2}: {row['name']}: {error}") from None
        if row["type"] == "JNTANG":
            joints[row["name"]] = TableColumn(k, factor, offset)
            continue
        columns = points.setdefault(point, {})
        name = row["name"] if column is None or column in columns else column
        columns[name] = TableColumn(k, factor, offset)
        frames.setdefault(point, row["reference_frame"].replace("n/a", ""))
    specs, fields = [], {}
    for point, columns in points.items():
        word = re.sub(r"[^0-9A-Za-z_]+", "_", point).strip("_") or "point"
        base = f"/{system}/{word}" if inertial else f"/reference/{word}"
        for schema, kind, groups in _SCHEMAS:
            taken = tuple(c for g in groups for c in columns if c.rpartition("_")[0] == g)
            if not taken or any(not set(_axes(g)) <= set(taken) for g in groups):
                continue
            if schema == IMU and "gyr_x" not in columns and "acc_x" not in columns:
                continue
            fields[f"{base}/{kind}"] = {c: columns.pop(c) for c in taken}
            specs.append(ChannelSpec(f"{base}/{kind}", schema, frames[point], taken))
        if columns:
            fields[f"{base}/values"] = columns
            specs.append(ChannelSpec(f"{base}/values", VALUES, frames[point], tuple(columns)))
    if joints:
        topic = f"/{system}/joint" if inertial else "/reference/joint"
        fields[topic] = joints
        specs.append(ChannelSpec(topic, JOINTS, "", tuple(joints)))
    return specs, fields


_SCHEMAS = (
    (IMU, "imu", ("acc", "gyr")),
    (IMU, "imu", ("acc",)),
    (IMU, "imu", ("gyr",)),
    (MAG, "mag", ("mag",)),
    (POSE, "pose", ("pos", "quat")),
    (POINT, "position", ("pos",)),
    (ROTATION, "orientation", ("quat",)),
    (VECTOR, "velocity", ("vel",)),
)
"""Message type, last part of the topic, and the groups of columns that it needs."""


def _axes(group: str) -> list[str]:
    return [f"{group}_{a}" for a in ("wxyz" if group == "quat" else "xyz")]


def _meaning(row: dict[str, str]) -> tuple[str | None, str]:
    """Return the column of the recording that a BIDS channel is, if any, and its unit."""
    group = _GROUPS.get(row["type"])
    component = row["component"].lower().removeprefix("quat_")
    if row["type"] == "JNTANG":
        return None, "rad"
    if group is None or component not in ("wxyz" if group == "quat" else "xyz"):
        return None, ""
    if group == "quat" and not row["component"].lower().startswith("quat_"):
        return None, ""  # Euler angles stay values: their order is not stated in a column
    return f"{group}_{component}", _UNITS.get(group, "")
