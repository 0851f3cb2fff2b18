"""Raw log in, recording out: finds the format, streams it, and keeps where everything came from."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import polars as pl

from .. import recording as mr
from ..recording.errors import Finding, MarchaError, OutputExists, UsageError, overflow_unsaid
from ..recording.files import as_unicode, require_other
from ..recording.provenance import provenance
from ..recording.threads import Prefetch, helpers
from . import registry
from .archive import UNPACK_LIMIT_GB
from .contract import (
    ChannelSpec,
    CommonOptions,
    Import,
    Report,
    ReportBuilder,
    SourceAttachment,
)
from .floor import Floor, floor_files, kind_of, read_floor
from .legchecks import LegWatch
from .mapping import mapping_format
from .radio import RadioWatch, addresses
from .truth import WALK_FACTS, TruthFile, as_text, read_truth, walk_facts
from .underlay import is_underlay, read_underlay

T = TypeVar("T")
MINUTE_NS = 60 * 10**9
"""An annotation may lie outside of the data by as much, and by as much as they are long."""


class ConvertedChannel(msgspec.Struct, frozen=True):
    """One channel of the result; times in ns, None where it stayed empty."""

    topic: str
    schema: str
    count: int
    start_ns: int | None
    end_ns: int | None


class Converted(msgspec.Struct, frozen=True):
    """What :func:`convert` did, with the keys of ``marcha convert --json``.

    ``also_read`` are files beside the sources that were read with them: truth, footprints, anchors.
    """

    output: str
    format: str
    channels: list[ConvertedChannel]
    report: Report
    also_read: list[str] = []


def convert(
    paths: Path | str | Sequence[Path | str],
    out: Path | str,
    *,
    format: str | None = None,
    mapping: Path | str | None = None,
    options: Mapping[str, Any] | None = None,
    truth: Mapping[str, Any] | None = None,
    strict: bool = False,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Converted:
    """Convert a raw log to a recording.

    Parameters
    ----------
    paths : path or sequence of paths
        File, folder or zip archive. Several become one recording: pieces of it where the format joins them,
        else sources beside each other, each on its own clock (metadata record ``clocks``).
    out : path
        The recording; appears whole or not at all.
    format : str, optional
        Name of the format; without it content decides.
    mapping : path, optional
        TOML mapping of a table's columns. The file is of the format ``table``, or of ``exo-csv`` where the
        mapping names segments; of several inputs the mapping belongs to those that no other format knows.
    options : mapping, optional
        The format's options (``marcha formats``), values also as text; of several formats
        ``format.option`` names one.
    truth : mapping, optional
        What is known of the walk: ``closed``, ``length_m`` (m), ``steps`` …; goes into the metadata record
        ``truth``, before what a side file says. ``closed`` and ``length_m`` may stand among the options too.
    strict : bool
        Fail where a row would be dropped or repaired.
    overwrite : bool
        Replace an existing recording.
    progress : callable, optional
        Called with the number of messages written so far.

    Raises
    ------
    MarchaError
        One line with file, rule, value and remedy. Nothing is written then.
    """
    sources = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    out = Path(out)
    chosen = dict(options or {})
    for k, path in enumerate(sources):
        if any(path.resolve() == earlier.resolve() for earlier in sources[:k]):
            raise UsageError(f"{path}: given twice; name each input once")
    under = [p for p in sources if is_underlay(p)]
    sources, beside = _apart([p for p in sources if p not in under])
    facts_of_walk = walk_facts({k: chosen.pop(k) for k in WALK_FACTS if k in chosen} | dict(truth or {}))
    place = {k.removeprefix("plan."): chosen.pop(k) for k in list(chosen) if k.startswith("plan.")}
    mapped = None
    if mapping is not None:
        chosen["mapping"], mapped = str(mapping), mapping_format(Path(mapping))
        if format not in (None, "table", "exo-csv"):
            raise UsageError(f"--map belongs to the formats table and exo-csv, not to {format}")
        format = format or (mapped if len(sources) == 1 else None)
    if out.is_dir():
        raise MarchaError(f"{out}: is a folder; give the name of the recording to write")
    require_other(out, sources)
    if out.exists() and not overwrite:
        raise OutputExists(out)
    with contextlib.ExitStack() as stack:
        stack.enter_context(overflow_unsaid())
        recognised = registry.choose(
            sources, format, stack, mapped=mapped, unpack_limit_gb=unpack_limit(options or {})
        )
        settings = registry.share_options(recognised, chosen)
        floor_report = ReportBuilder()
        own = [f for (registered, files) in recognised for f in floor_files(registered.importer, files)]
        named = {kind_of(p) for p in beside}  # what the user names beside a log goes before its own
        floor = read_floor([*beside, *(f for f in own if kind_of(f) not in named)], place, floor_report)
        floor.attachments += read_underlay(under)
        beside += under
        side_files = [read_truth(source.files[0]) for source in recognised]
        facts = {
            "importer": ", ".join(dict.fromkeys(r.importer.name for r, _ in recognised)),
            "importer_version": ", ".join(dict.fromkeys(r.source for r, _ in recognised)),
            "options": chosen | facts_of_walk | {f"plan.{k}": v for k, v in place.items()},
            "given": ", ".join(as_unicode(p.name) for p in (*sources, *beside)),
        }
        read = [
            p for (_, files), side in zip(recognised, side_files, strict=True) for p in _read(files, side)
        ] + beside
        origin = stack.enter_context(helpers("hash", 1)).submit(provenance, read, **facts)
        try:
            with mr.create(out, overwrite=overwrite) as recording:
                merged = _Merged(len(recognised), floor, facts_of_walk)
                written = _Writer(recording, progress)
                for source, setting, side in zip(recognised, settings, side_files, strict=True):
                    imported = source.registered.importer.read(source.files, setting)
                    if strict:
                        imported.refuse_changes(source.files[0])
                    merged.add(source, setting, side, imported, written)
                report = merged.report(floor_report.build())
                for name, record in (merged.records(report) | {"provenance": origin.result()}).items():
                    recording.add_metadata(name, record)
                for item in merged.attachments:
                    recording.add_attachment(item.name, item.data, item.media_type)
                for marks in merged.annotations:
                    recording.add_annotations(marks)
        except OSError as error:
            where = error.filename or out
            raise MarchaError(f"{where}: {error.strerror or error}; nothing was written to {out}") from error
    return Converted(str(out), facts["importer"], written.channels(), report, merged.also_read)


class _Merged:
    """What the sources of one recording say: their channels, reports, metadata and attachments."""

    def __init__(self, count: int, floor: Floor, facts: dict[str, str]) -> None:
        self._several = count > 1
        self._facts = facts
        self._floor = floor
        self._reports: list[tuple[list[str], Report]] = []
        self._records: dict[str, dict[str, str]] = {"plan": floor.metadata} if floor.metadata else {}
        self._clocks: dict[str, str] = {}
        self.attachments: list[SourceAttachment] = list(floor.attachments)
        self.annotations: list[pl.DataFrame] = []
        self.also_read: list[str] = []

    def add(
        self,
        source: registry.ChosenSource,
        options: CommonOptions,
        truth: TruthFile | None,
        imported: Import,
        written: _Writer,
    ) -> None:
        """Stream one source into the recording."""
        name = as_unicode(source.files[0].name)
        self.also_read += [str(p) for p in (*imported.also_read, *(truth.files if truth else ()))]
        written.begin(options, name, len(self._reports))
        for spec in imported.channels:
            written.declare(spec)
        watch, radio = LegWatch(imported.channels), RadioWatch(imported.channels)
        with contextlib.closing(Prefetch(imported.blocks(), "parse")) as blocks:
            for topic, table in blocks:
                watch.feed(topic, table)
                radio.feed(topic, table)
                written.add(topic, table)
        anchors = [*self._floor.anchors, *addresses(imported.attachments)]
        files = [as_unicode(p.name) for p in source.files]
        report = radio.finish(watch.finish(imported.report), anchors)
        specs = [*imported.channels, *(spec for spec, _ in truth.tables)] if truth else imported.channels
        for spec, table in truth.tables if truth else ():
            written.declare(spec)
            written.add(spec.topic, table)
        self._clocks |= {spec.topic: name for spec in specs} | imported.metadata.pop("clocks", {})
        for key, record in _metadata(imported, options, truth).items():
            self._records[key if key not in self._records else f"{key}/{name}"] = record
        for marks in (imported.annotations, truth.annotations if truth else None):
            if marks is not None:
                near, report = _near(written.moved(marks), written.span(), report)
                self.annotations.append(near)
        self._reports.append((files, report))
        raw = _raw(source.files) if options.keep_source else ()
        names = {a.name for a in self.attachments}  # what the user names beside a log goes before its own
        self.attachments += [a for a in (*imported.attachments, *raw) if a.name not in names]

    def report(self, floor: Report) -> Report:
        """Return the report of all sources; of several a finding names its files. ``floor`` is that of the plan."""
        if not self._several:
            return _beside(self._reports[0][1], floor)
        counts = {
            key: sum(getattr(r, key) for _, r in self._reports)
            for key in ("rows_read", "rows_kept", "rows_repaired", "rows_dropped")
        }
        findings = [
            f
            if any(name in f.detail for name in files)
            else msgspec.structs.replace(f, detail=f"{' + '.join(files[:4])}: {f.detail}")
            for files, r in self._reports
            for f in r.findings
        ]
        whole = Report(**counts, findings=findings, lossy=any(r.lossy for _, r in self._reports))
        return _beside(whole, floor)

    def records(self, report: Report) -> dict[str, dict[str, str]]:
        """Return all metadata records but the provenance."""
        records = dict(self._records)
        if self._facts:
            records["truth"] = records.get("truth", {}) | self._facts
        if len(set(self._clocks.values())) > 1:
            records["clocks"] = self._clocks
        keys = ("rows_read", "rows_kept", "rows_repaired", "rows_dropped")
        records["import_report"] = {
            **{key: str(getattr(report, key)) for key in keys},
            "lossy": as_text(report.lossy),
            "findings": msgspec.json.encode(report.findings).decode(),
        }
        return records


def _beside(report: Report, floor: Report) -> Report:
    """Return the report of the sources with what was found in anchor table and plan."""
    if not floor.findings:
        return report
    return msgspec.structs.replace(
        report, findings=[*report.findings, *floor.findings], lossy=report.lossy or floor.lossy
    )


def _near(marks: pl.DataFrame, span: tuple[int, int] | None, report: Report) -> tuple[pl.DataFrame, Report]:
    """Return the annotations but those far from the data, which would stretch the recording; these are found."""
    if span is None:
        return marks, report
    first, last = span
    reach = max(last - first, MINUTE_NS)
    is_far = (pl.col("start_ns") > last + reach) | (pl.col("end_ns") < first - reach)
    far = marks.filter(is_far)
    if far.is_empty():
        return marks, report
    label, start_ns = far["label"][0], int(far["start_ns"][0])
    off_s = max(start_ns - last, first - start_ns) * 1e-9
    finding = Finding(
        "annotation_outside",
        far.height,
        None,
        f"{label!r} lies {off_s:.0f} s outside of the data, by more than their whole length; left out",
    )
    report = msgspec.structs.replace(report, findings=[*report.findings, finding], lossy=True)
    return marks.filter(~is_far), report


def _apart(sources: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the logs, and the anchor table and plan among what was given."""
    kinds = {p: kind_of(p) for p in sources}  # a picture's eight bytes say more than the one that marks C3D
    beside = [p for p in sources if kinds[p] == "picture" or (kinds[p] and not registry.recognise(p))]
    logs = [p for p in sources if p not in beside]
    if not logs:
        if not beside:
            raise UsageError("what lies under a map goes into a recording beside a log; give the log as well")
        raise UsageError(
            f"{beside[0]}: an anchor table or plan goes into a recording beside a log; give the log as well"
        )
    return logs, beside


class _Writer:
    """Hands tables to the recording, moved to UTC where asked, and counts them."""

    def __init__(self, recording: Any, progress: Callable[[int], None] | None) -> None:
        self._recording = recording
        self._progress = progress
        self._total = 0
        self._start: int | None = None
        self._shift = 0
        self._source = (0, "")
        self._from: dict[str, tuple[int, str]] = {}
        self._specs: dict[str, ChannelSpec] = {}
        self._counts: dict[str, tuple[int, int | None, int | None]] = {}

    def begin(self, options: CommonOptions, source: str, number: int) -> None:
        """Start a source: its clock is moved as its options say."""
        self._source = (number, source)
        self._start = None if options.start is None else _instant("start", options.start)
        self._shift = 0 if options.epoch is None else _instant("epoch", options.epoch)
        if options.start is not None and options.epoch is not None:
            raise UsageError("start and epoch both say when the device's clock began; give one")

    def declare(self, spec: ChannelSpec) -> None:
        if (other := self._from.setdefault(spec.topic, self._source)) != self._source:
            raise MarchaError(
                f"{self._source[1]}: {spec.topic} comes from {other[1]} already; give one of them other names "
                "(--set FORMAT.segments=…), or convert them one by one"
            )
        self._specs[spec.topic] = spec
        self._counts[spec.topic] = (0, None, None)
        self._recording.add_channel(
            spec.topic,
            spec.schema,
            frame_id=spec.frame_id,
            columns=spec.columns or None,
            metadata=spec.metadata,
        )

    def add(self, topic: str, table: pl.DataFrame) -> None:
        if not table.height:
            return
        if self._start is not None:  # the first sample is that of the first block
            self._shift, self._start = self._start - int(table["t_ns"][0]), None
        if self._shift:
            table = table.with_columns(pl.col("t_ns") + self._shift)
        spec = self._specs[topic]
        self._recording.add_table(topic, spec.schema, table, frame_id=spec.frame_id)
        count, first, _ = self._counts[topic]
        t = table["t_ns"]
        self._counts[topic] = (count + table.height, int(t[0]) if first is None else first, int(t[-1]))
        self._total += table.height
        if self._progress is not None:
            self._progress(self._total)

    def moved(self, annotations: pl.DataFrame) -> pl.DataFrame:
        """Return annotations on the clock to which the source's messages were moved."""
        return annotations.with_columns(pl.col("start_ns", "end_ns") + self._shift)

    def span(self) -> tuple[int, int] | None:
        """Return the first and the last time of the present source's messages, None without any."""
        own = [self._counts[topic][1:] for topic, source in self._from.items() if source == self._source]
        times = [t for pair in own for t in pair if t is not None]
        return (min(times), max(times)) if times else None

    def channels(self) -> list[ConvertedChannel]:
        return [
            ConvertedChannel(topic, self._specs[topic].schema, *numbers)
            for topic, numbers in self._counts.items()
        ]


def unpack_limit(chosen: Mapping[str, Any]) -> float:
    """Return how much an archive may unpack to (GB): needed before the format is known."""
    value = chosen.get("unpack_limit_gb", UNPACK_LIMIT_GB)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UsageError(f"option unpack_limit_gb={value!r} is no number of GB") from None


def _instant(option: str, text: str) -> int:
    """Return an ISO 8601 time as ns since 1970, UTC where it names no zone."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(
            f"option {option}={text!r} is no ISO 8601 time, such as 2026-11-21T10:00:00Z"
        ) from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    nanoseconds = (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000
    if nanoseconds < 0:
        raise UsageError(f"option {option}={text!r} lies before 1970")
    return nanoseconds


def _metadata(
    imported: Import,
    options: CommonOptions,
    truth: TruthFile | None,
) -> dict[str, dict[str, str]]:
    records = {name: dict(record) for name, record in imported.metadata.items()}
    if options.epoch is not None or options.start is not None:
        records.setdefault("device", {})["clock"] = "utc"
    if truth and truth.metadata:
        records["truth"] = records.get("truth", {}) | truth.metadata
    return records


def _read(files: Sequence[Path], truth: TruthFile | None) -> Iterator[Path]:
    """Yield every file that a source is read from."""
    yield from (p for _, p in _files([*files, *(truth.files if truth else ())]))


def _files(paths: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    for path in paths:
        if path.is_dir():
            yield from ((p.relative_to(path).as_posix(), p) for p in sorted(path.rglob("*")) if p.is_file())
        else:
            yield path.name, path


def _raw(paths: Sequence[Path]) -> Iterator[SourceAttachment]:
    for name, path in _files(paths):
        yield SourceAttachment(f"source/{as_unicode(name)}", path.read_bytes(), "application/octet-stream")
