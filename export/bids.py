"""Motion-BIDS (BEP 029): readings as raw data, estimates as derivatives, annotations as events."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec
import polars as pl

from ..recording import Recording
from ..recording.annotations import EVENT
from ..recording.errors import UsageError
from ..recording.events import SIDECAR, TABLE, bids_events, events_text, sidecar, to_events
from ..recording.names import ESTIMATE, free_name
from ..recording.selection import Selection, selected_topics, within
from ..recording.threads import Prefetch
from .facts import FIRST_DATE_NS, origin, pretty
from .folder import whole_folder
from .tables import meaning

VERSION = "1.9.0"
MARKER = "dataset_description.json"
KNOWN_AT = "t_log_ns"
_KINDS = {"acc": "ACCEL", "gyr": "GYRO", "mag": "MAGN", "quat": "ORNT", "pos": "POS", "vel": "VEL"}
_UNITS = {"m/s²": "m/s^2", "°": "deg", "°C": "oC", "-": "n/a", "": "n/a", "as named": "n/a", "Pa": "Pa"}
_COUNTED = ("ACCEL", "GYRO", "MAGN", "ORNT", "POS", "VEL", "JNTANG", "LATENCY", "MISC")
_LABEL_SIGNS = 64
"""Of a tracking system: its files are named by it, and file systems take 255 bytes."""


class BidsOptions(Selection, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a BIDS dataset."""

    subject: Annotated[
        str, msgspec.Meta(pattern="^[0-9a-zA-Z]+$", description="sub-…: letters and digits")
    ] = "01"
    session: Annotated[str, msgspec.Meta(pattern="^[0-9a-zA-Z]*$", description="ses-…; none where empty")] = (
        ""
    )
    task: Annotated[str, msgspec.Meta(pattern="^[0-9a-zA-Z]+$", description="task-…")] = "walk"
    run: Annotated[str, msgspec.Meta(pattern="^[0-9]*$", description="run-…; none where empty")] = ""
    derivatives: Annotated[bool, msgspec.Meta(description="write estimates below derivatives/marcha")] = True
    license: Annotated[str, msgspec.Meta(description="licence of the data, as SPDX")] = "n/a"


class System(NamedTuple):
    """Channels that share their times: a tracking system of its own."""

    label: str
    name: str
    topics: list[str]


class BidsExporter:
    """A Motion-BIDS dataset of one recording; :func:`write_dataset` writes one of many."""

    name: ClassVar[str] = "bids"
    title: ClassVar[str] = "Motion-BIDS dataset: raw, derivatives, events (reviewers, data archives)"
    suffix: ClassVar[str] = ""
    Options: ClassVar[type[msgspec.Struct]] = BidsOptions

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what the dataset has no place for; it is in marcha.json beside it or named there."""
        odd = [
            t
            for t in selected_topics(rec, options)
            if rec.channels[t].schema != EVENT and not numeric_columns(rec, t)
        ]
        losses = ["line breaks, tabs and quotation marks in labels: written as signs, whole in sourcedata"]
        if odd:
            losses.append(f"channels without numbers: {', '.join(odd)}")
        texts = [
            f"{t} {', '.join(text_columns(rec, t))}"
            for t in selected_topics(rec, options)
            if t not in odd and rec.channels[t].schema != EVENT and text_columns(rec, t)
        ]
        if texts:
            losses.append(f"columns of text: {'; '.join(texts)}")
        if others := [a.name for a in rec.attachments if a.name not in (TABLE, SIDECAR)]:
            losses.append(f"attachments: {', '.join(others)}")
        return losses

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the dataset; see :class:`marcha.export.Exporter`."""
        return write_dataset({rec: options}, path, overwrite=overwrite)

    def export_all(
        self, recs: Sequence[Recording], path: Path, options: Any, *, overwrite: bool = False
    ) -> list[Path]:
        """Write one dataset of several recordings; their file names state their entities."""
        return write_dataset({rec: entities(rec, options) for rec in recs}, path, overwrite=overwrite)


_ENTITIES = re.compile(
    r"sub-(?P<subject>[0-9A-Za-z]+)(_ses-(?P<session>[0-9A-Za-z]+))?(_task-(?P<task>[0-9A-Za-z]+))?"
    r"(_tracksys-[0-9A-Za-z]+)?(_run-(?P<run>[0-9]+))?(_[^/]*)?"
)


def entities(rec: Recording, options: BidsOptions) -> BidsOptions:
    """Return options with the subject, session, task and run that a recording's file name states.

    Raises
    ------
    UsageError
        The name states no subject.
    """
    match = _ENTITIES.fullmatch(rec.path.stem)
    if match is None:
        raise UsageError(
            f"{rec.path}: a dataset of several recordings needs their subjects; name the files "
            "sub-01_task-walk.mcap (sub-…_ses-…_task-…_run-…)"
        )
    return msgspec.structs.replace(options, **{k: v for k, v in match.groupdict().items() if v})


def write_dataset(
    recordings: Mapping[Recording, BidsOptions], path: Path, *, overwrite: bool = False
) -> list[Path]:
    """Write a dataset of one or many recordings.

    Parameters
    ----------
    recordings : mapping of Recording to BidsOptions
        Each with its own subject, session, task or run.
    path : Path
        The folder.
    overwrite : bool
        Whether an earlier dataset that marcha wrote may be replaced.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    UsageError
        Two recordings have the same entities, or one has nothing to write.
    """
    stems = [f"{_stem(o)} {o.run}" for o in recordings.values()]
    if len(set(stems)) != len(stems):
        raise UsageError(f"{path}: two recordings would have one name; give each its subject, session or run")
    with whole_folder(path, overwrite=overwrite, marker=MARKER) as folder:
        files = _Files(folder)
        about = {}
        licenses = {o.license for o in recordings.values()} - {"n/a"}
        derived = [_write_recording(files, rec, o, about) for rec, o in recordings.items()]
        _describe(files, "", "raw", licenses)
        if any(derived):
            _describe(files, "derivatives/marcha/", "derivative", licenses)
        for name, rows in files.scans.items():
            table = pl.DataFrame(rows, schema=["filename", "acq_time"], orient="row")
            files.text(name, table.write_csv(separator="\t"))
        subjects = sorted({f"sub-{o.subject}" for o in recordings.values()})
        table = pl.DataFrame({"participant_id": subjects})
        files.text("participants.tsv", table.write_csv(separator="\t"))
        files.json("participants.json", {"participant_id": {"Description": "subject"}})
        files.json("sourcedata/marcha.json", about)
    return [path / name for name in files.names]


class _Files:
    """The files of a dataset, by their names in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: list[str] = []
        self.scans: dict[str, list[tuple[str, str]]] = {}

    def place(self, name: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self.names.append(name)
        return path

    def text(self, name: str, text: str) -> None:
        self.place(name).write_text(text, encoding="utf-8", newline="\n")

    def json(self, name: str, value: Any) -> None:
        self.place(name).write_bytes(pretty(value))


def _stem(options: BidsOptions) -> str:
    parts = [f"sub-{options.subject}"]
    parts += [f"ses-{options.session}"] if options.session else []
    return "_".join([*parts, f"task-{options.task}"])


def _describe(files: _Files, base: str, kind: str, licenses: set[str]) -> None:
    facts: dict[str, Any] = {
        "Name": "Walks recorded with inertial sensors" if kind == "raw" else "Estimates of marcha",
        "BIDSVersion": VERSION,
        "DatasetType": kind,
        "License": " AND ".join(sorted(licenses)) or "n/a",
        "GeneratedBy": [{"Name": "marcha", "Version": version("marcha")}],
    }
    if kind == "derivative":
        facts["SourceDatasets"] = [{"URL": "../../"}]
    files.json(f"{base}dataset_description.json", facts)
    text = (
        "Walks recorded with inertial sensors and references, written by marcha as Motion-BIDS.\n\n"
        "Times count from the start of each recording; the LATENCY channel has the exact time of each row.\n"
        "Quaternions have their real part first and take coordinates from the sensor to the navigation frame.\n"
    )
    files.text(f"{base}README", text if kind == "raw" else "Estimates that marcha made of the raw data.\n")


def _write_recording(files: _Files, rec: Recording, options: BidsOptions, about: dict[str, Any]) -> bool:
    """Write one recording; return whether it has derivatives."""
    topics = [
        t
        for t in selected_topics(rec, options)
        if rec.channels[t].schema != EVENT and rec.channels[t].count and numeric_columns(rec, t)
    ]
    raw = [t for t in topics if not t.startswith(ESTIMATE)]
    own = [t for t in topics if t.startswith(ESTIMATE)] if options.derivatives else []
    if not raw:
        raise UsageError(f"{rec.path}: no chosen channel has readings for a BIDS dataset")
    session = f"/ses-{options.session}" if options.session else ""
    folder = f"sub-{options.subject}{session}/motion/"
    run = f"_run-{options.run}" if options.run else ""
    stem = _stem(options)
    scans = []
    columns: dict[str, list[tuple[str, str, str, str]]] = {}
    for base, chosen in (("", raw), ("derivatives/marcha/", own)):
        for system in systems(rec, chosen, options):
            name = f"{stem}_tracksys-{system.label}{run}"
            if base:
                name += "_desc-estimate"
            columns[f"{name}_motion.tsv"] = _write_system(
                files, rec, options, system, f"{base}{folder}{name}"
            )
            if not base:
                scans.append(f"motion/{name}_motion.tsv")
    events = to_events(within(rec.annotations, options), rec.start_ns)
    if events.height:
        files.text(f"sourcedata/{stem}{run}_events.tsv", events_text(events))  # with every sign
        files.text(
            f"{folder}{stem}{run}_events.tsv",
            bids_events(events).write_csv(separator="\t", null_value="n/a", quote_style="never"),
        )
        files.json(f"{folder}{stem}{run}_events.json", sidecar(rec.metadata))
    base = f"sub-{options.subject}{session}"
    files.scans.setdefault(f"{base}/{base.replace('/', '_')}_scans.tsv", []).extend(
        (name, _date(rec)) for name in scans
    )
    channels = {
        t: {
            "schema": rec.channels[t].schema,
            "frame_id": rec.channels[t].frame_id,
            "metadata": rec.channels[t].metadata,
            "columns": rec.channels[t].columns,
        }
        for t in (*raw, *own)
    }
    about[f"{stem}{run}"] = {
        **origin(rec),
        "channels": channels,
        "columns": columns,
        "metadata": rec.metadata,
    }
    return bool(own)


def _date(rec: Recording) -> str:
    if rec.start_ns < FIRST_DATE_NS:
        return "n/a"
    whole, rest = divmod(rec.start_ns, 10**9)
    return datetime.fromtimestamp(whole, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{rest // 1000:06d}Z"


def numeric_columns(rec: Recording, topic: str) -> list[str]:
    """Return the columns of a channel that are numbers, without the time of each row."""
    empty = rec.table(topic, start_ns=0, end_ns=0)
    return [n for n, d in empty.schema.items() if (d.is_numeric() or d == pl.Boolean) and n != "t_ns"]


def text_columns(rec: Recording, topic: str) -> list[str]:
    """Return the columns of a channel that a motion table cannot hold."""
    return [
        c
        for c in rec.table(topic, start_ns=0, end_ns=0).columns
        if c not in (*numeric_columns(rec, topic), "t_ns")
    ]


def systems(rec: Recording, topics: list[str], options: Selection) -> list[System]:
    """Return the tracking systems: channels of a device with the same times are one.

    A device is the first part of a topic, a run for estimates.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    alike = Counter((_device(t), rec.channels[t].count) for t in topics)
    for topic in topics:
        device, count = _device(topic), rec.channels[topic].count
        key = f"{count}"
        if alike[device, count] > 1:  # only channels of as many rows can have the same times
            rows, digest = 0, 0
            for (table,) in _rows(rec, [topic], options):
                rows += table.height
                digest = (digest + table["t_ns"].hash(0).sum()) % 2**64
            key = f"{count}/{rows}/{digest}" if rows else ""
        groups.setdefault((device, key), []).append(topic)
    out, taken = [], set()
    for (device, _), members in groups.items():
        alone = sum(d == device for d, _ in groups) == 1
        name = device if alone else members[0].strip("/")
        word = re.sub(r"[^0-9A-Za-z]", "", name)[:_LABEL_SIGNS] or "system"
        label, number = word, 1
        while label.lower() in taken:
            number += 1
            label = f"{word}{number}"
        taken.add(label.lower())
        out.append(System(label, name, members))
    return out


def _device(topic: str) -> str:
    parts = topic.strip("/").split("/")
    return parts[1] if topic.startswith(ESTIMATE) and len(parts) > 2 else parts[0]


def _write_system(
    files: _Files, rec: Recording, options: BidsOptions, system: System, stem: str
) -> list[tuple[str, str, str, str]]:
    """Write one tracking system; return where each column comes from."""
    path, later = files.place(f"{stem}_motion.tsv"), set[str]()
    origin_of = _origins(rec, system, later)
    while (times := _write_rows(rec, options, system, origin_of, path, later)) is None:
        origin_of = _origins(rec, system, later)
    first, last, count = times
    duration_ns = last - first
    rate = (count - 1) * 1e9 / duration_ns if duration_ns > 0 else 0.0
    rows = [("latency", "n/a", "LATENCY", "n/a", "s", "n/a", rate, "time since the start of the recording")]
    for name, topic, column, _ in origin_of:
        schema = rec.channels[topic].schema
        group, _, axis = column.rpartition("_")
        kind_of = _KINDS.get(group)
        joint = schema == "sensor_msgs/msg/JointState"
        kind = "JNTANG" if joint and not column.endswith((".vel", ".effort")) else kind_of or "MISC"
        component = axis if axis in ("x", "y", "z") else "n/a"
        if kind_of == "ORNT":
            component = f"quat_{axis}"
        about = meaning(schema, column)
        if column == KNOWN_AT:
            about = {"unit": "s", "meaning": "when it was known, since the start of the recording"}
        unit = _UNITS.get(about["unit"], about["unit"])
        frame = rec.channels[topic].frame_id or "n/a"
        if column.endswith("_ns"):
            unit = "s"
        if kind == "ORNT":
            unit = "n/a"
        rows.append((name, component, kind, topic.strip("/"), unit, _frame(frame), rate, about["meaning"]))
    heads = [
        "name",
        "component",
        "type",
        "tracked_point",
        "units",
        "reference_frame",
        "sampling_frequency",
        "description",
    ]
    listing = pl.DataFrame([tuple(r) for r in rows], schema=heads, orient="row")
    channels_stem = stem
    files.text(f"{channels_stem}_channels.tsv", listing.write_csv(separator="\t", null_value="n/a"))
    frames = sorted({r[5] for r in rows} - {"n/a"})
    if frames:
        levels = {
            f: {
                "SpatialAxes": "n/a",
                "RotationRule": "right-hand",
                "RotationOrder": "n/a",
                "Description": f"frame {f} of the recording",
            }
            for f in frames
        }
        files.json(f"{channels_stem}_channels.json", {"reference_frame": {"Levels": levels}})
    kinds = [r[2] for r in rows]
    facts: dict[str, Any] = {
        "TaskName": options.task,
        "SamplingFrequency": rate,
        "SamplingFrequencyEffective": rate,
        "TrackingSystemName": system.name,
        "MotionChannelCount": len(rows),
        "TrackedPointsCount": len(system.topics),
        "RecordingDuration": duration_ns / 1e9,
        "MissingValues": "n/a",
        "RecordingType": "continuous",
        **{f"{k}ChannelCount": kinds.count(k) for k in _COUNTED if k in kinds},
    }
    files.json(f"{stem}_motion.json", facts)
    return origin_of


def _origins(rec: Recording, system: System, later: set[str]) -> list[tuple[str, str, str, str]]:
    """Return name in the table, topic, column and kind of number of each column that is written."""
    taken: set[str] = set()  # /leg/a/b and /leg/a_b have the same name here
    return [
        (
            free_name(f"{topic.strip('/').replace('/', '_')}_{column}", taken),
            topic,
            column,
            str(types[column]),
        )
        for topic in system.topics
        for types in [rec.table(topic, start_ns=0, end_ns=0, log_time=True).schema]
        for column in [*numeric_columns(rec, topic), *([KNOWN_AT] if topic in later else [])]
    ]


def _write_rows(
    rec: Recording,
    options: BidsOptions,
    system: System,
    origin_of: list[tuple[str, str, str, str]],
    path: Path,
    later: set[str],
) -> tuple[int, int, int] | None:
    """Write the rows of a tracking system.

    Returns
    -------
    tuple of int or None
        First and last time and the number of rows; None where a channel is known later than measured that is
        not in ``later``: it is now, and has one more column.
    """
    first = last = count = 0
    with closing(Prefetch(_rows(rec, system.topics, options), "export")) as rows, path.open("wb") as file:
        for tables in rows:
            by_topic = dict(zip(system.topics, tables, strict=True))
            late_ones = {t for t, table in by_topic.items() if (table[KNOWN_AT] != table["t_ns"]).any()}
            if not late_ones <= later:
                later |= late_ones
                return None
            t_ns = tables[0]["t_ns"]
            first, last, count = first if count else t_ns[0], t_ns[-1], count + len(t_ns)
            columns = [_seconds(t_ns, rec).alias("latency")]
            columns += [
                _cells(by_topic[topic], column, rec).alias(name) for name, topic, column, _ in origin_of
            ]
            pl.DataFrame(columns).with_columns(pl.selectors.float().fill_nan(None)).write_csv(
                file, separator="\t", include_header=False, null_value="n/a", float_scientific=None
            )
    return first, last, count


def _rows(rec: Recording, topics: Sequence[str], options: Selection) -> Iterator[tuple[pl.DataFrame, ...]]:
    """Yield the next rows, as many of each channel: channels of the same times may be known at others."""
    held: list[pl.DataFrame] = [rec.table(t, start_ns=0, end_ns=0, log_time=True) for t in topics]
    for window in rec.windows(topics, start_ns=options.start_ns, end_ns=options.end_ns):
        held = [
            pl.concat([h, window.tables[t]], how="diagonal_relaxed") if t in window.tables else h
            for t, h in zip(topics, held, strict=True)
        ]
        whole = min(h.height for h in held)
        if whole:
            yield tuple(h.head(whole) for h in held)
            held = [h.slice(whole) for h in held]


def _seconds(t_ns: pl.Series, rec: Recording) -> pl.Series:
    return pl.Series((t_ns.to_numpy() - rec.start_ns) / 1e9)  # Polars would multiply by a rounded 1e-9


def _cells(table: pl.DataFrame, column: str, rec: Recording) -> pl.Series:
    """Return a column as it is written: times from the start of the recording, flags as 0 and 1."""
    if column.endswith("_ns"):
        return _seconds(table[column], rec)
    return table[column].cast(pl.Int8) if table[column].dtype == pl.Boolean else table[column]


def _frame(frame_id: str) -> str:
    return re.sub(r"[^0-9A-Za-z_]", "_", frame_id) if frame_id != "n/a" else "n/a"
