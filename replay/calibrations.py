"""Calibrations: made from recordings, kept in files and recordings, applied to channels before estimators see them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import polars as pl

from ..algorithms import CALIBRATIONS, build_params, find
from ..algorithms.calibration import Calibration, Stretch
from ..algorithms.contract import ALL_COLUMNS, AlgorithmError, ChannelInfo, FloatArray, Input
from ..recording.atomic import AtomicFile
from ..recording.errors import Finding, MarchaError, UsageError
from ..recording.provenance import environment, hash_file
from .attachment import NamedChannels, attach
from .sources import RecordingSource

if TYPE_CHECKING:
    from ..recording import Recording

RECORD = "calibration/"
"""Prefix of the metadata records in which a recording keeps calibrations, each as JSON under the key ``json``."""

CORRECTED: dict[str, tuple[tuple[str, tuple[str, str, str], str, str], ...]] = {
    "imu": (
        ("sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z"), "acc_matrix", "acc_offset_m_s2"),
        ("sensor_msgs/msg/Imu", ("gyr_x", "gyr_y", "gyr_z"), "gyr_matrix", "gyr_offset_rad_s"),
    ),
    "magnetometer": (
        ("sensor_msgs/msg/MagneticField", ("mag_x", "mag_y", "mag_z"), "mag_matrix", "mag_offset_t"),
    ),
}
"""Kinds that the engine applies: message type, columns, names of matrix M and offset b in ``M (x − b)``."""


def calibrations_of(metadata: Mapping[str, Mapping[str, str]]) -> list[Calibration]:
    """Return the calibrations that a recording carries."""
    return [
        _decode(record.get("json", ""), name) for name, record in metadata.items() if name.startswith(RECORD)
    ]


def usable(calibrations: Iterable[Calibration]) -> dict[str, Calibration]:
    """Return those that may be applied, by kind and subject; the first of a kind and subject counts."""
    result: dict[str, Calibration] = {}
    for one in calibrations:
        if one.usable:
            result.setdefault(f"{one.kind}:{one.subject}" if one.subject else one.kind, one)
    return result


def metadata_of(calibrations: Iterable[Calibration]) -> dict[str, dict[str, str]]:
    """Return the metadata records that keep calibrations in a recording."""
    return {
        f"{RECORD}{c.kind}" + (f":{c.subject}" if c.subject else ""): {
            "json": msgspec.json.encode(c).decode()
        }
        for c in calibrations
    }


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Raises
    ------
    MarchaError
        It is not there or no calibration.
    """
    path = Path(path)
    try:
        return _decode(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise MarchaError(f"{path}: is no calibration (not UTF-8); `marcha calibrate` writes one") from None


def save_calibration(calibration: Calibration, path: Path | str, overwrite: bool = False) -> None:
    """Write a calibration file (JSON), whole or not at all."""
    file = AtomicFile(Path(path), overwrite=overwrite)
    file.write(msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n")
    file.commit()


def _decode(text: str, where: str) -> Calibration:
    try:
        return msgspec.json.decode(text, type=Calibration)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise MarchaError(f"{where}: is no calibration: {error}; `marcha calibrate` writes one") from None


def calibrate(
    name: str,
    recordings: Sequence[Recording],
    params: Mapping[str, Any] | None = None,
    *,
    inputs: Sequence[str] | None = None,
    interval: str | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> list[Calibration]:
    """Let a calibration look at recordings, once.

    Parameters
    ----------
    name : str
        ``imu``, ``magnetometer`` …; ``marcha estimators`` lists them.
    recordings : sequence of Recording
        What it looks at, together.
    params : mapping, optional
        Its parameters.
    inputs : sequence of str, optional
        ``role=topic``, or topics alone; without it every channel that fits, one result each.
    interval : str, optional
        Label or tier of annotations: only what lies in them.
    start_ns, end_ns : int, optional
        Range of log times, half open.

    Returns
    -------
    list of Calibration
        One for each device that it fits, as :mod:`.attachment` decides.

    Raises
    ------
    UsageError
        Unknown names, parameters or topics; no channel that fits; no such annotation; unusable data.
    """
    try:
        cls = find(name, CALIBRATIONS)
        calibrator = cls(build_params(name, cls, dict(params or {})))
    except AlgorithmError as error:
        raise UsageError(str(error)) from None
    if not recordings:
        raise UsageError(f"calibration {name}: no recording given")
    chosen = NamedChannels.parse(inputs or ())
    sources = [RecordingSource(r) for r in recordings]
    chosen.check(sources[0], (i.name for i in calibrator.inputs))
    spans = [(s, span, label) for s in sources for span, label in _spans(s, interval, start_ns, end_ns)]
    digests = {id(s): hash_file(Path(s.recording.path)) for s in sources}
    calibrations: list[Calibration] = []
    for attachment in attach(calibrator.inputs, name, sources[0], chosen, {}):
        topics = {role: tuple(c.topic for c in channels) for role, channels in attachment.channels.items()}
        stretches = [
            _stretch(source, calibrator.inputs, topics, span, label) for source, span, label in spans
        ]
        try:
            result = calibrator.calibrate(stretches)
        except AlgorithmError as error:
            raise UsageError(f"calibration {name}: {error}") from None
        result.version = environment().partition(";")[0]
        result.params = msgspec.to_builtins(calibrator.params)
        result.computed_from = [
            {
                "recording": source.name,
                "blake2b": digests[id(source)],
                "start_ns": str(span[0] if span[0] is not None else source.start_ns),
                "end_ns": str(span[1] if span[1] is not None else source.end_ns),
            }
            for source, span, _ in spans
        ]
        calibrations.append(result)
    return calibrations


Span = tuple[int | None, int | None]


def _spans(
    source: RecordingSource, interval: str | None, start_ns: int | None, end_ns: int | None
) -> list[tuple[Span, str]]:
    if interval is None:
        return [((start_ns, end_ns), source.name)]
    marked = source.recording.annotations
    marked = marked.filter((pl.col("label") == interval) | (pl.col("tier") == interval))
    if not marked.height:
        raise UsageError(f"{source.name}: no annotation with label or tier {interval!r}")
    return [
        ((row["start_ns"], row["end_ns"] + 1), f"{source.name}: {row['label']}")
        for row in marked.iter_rows(named=True)
    ]


def _stretch(
    source: RecordingSource,
    inputs: Sequence[Input],
    topics: Mapping[str, tuple[str, ...]],
    span: Span,
    label: str,
) -> Stretch:
    tables: dict[str, tuple[pl.DataFrame, ...]] = {}
    channels: dict[str, tuple[ChannelInfo, ...]] = {}
    for need in inputs:
        parts, infos = [], []
        for topic in topics[need.name]:
            if topic not in source.channels:
                raise UsageError(f"{source.name}: no channel {topic}, which the first recording has")
            channel = source.channels[topic]
            columns = channel.columns if need.columns == ALL_COLUMNS else need.columns
            table = source.recording.table(topic, start_ns=span[0], end_ns=span[1])
            if need.regular:
                table = table.filter(pl.all_horizontal(pl.col(columns).is_finite())).unique(
                    "t_ns", keep="first", maintain_order=True
                )
            parts.append(table)
            infos.append(
                ChannelInfo(
                    topic, channel.schema, channel.frame_id, columns, source.rate_hz(topic), channel.metadata
                )
            )
        tables[need.name], channels[need.name] = tuple(parts), tuple(infos)
    return Stretch(channels, tables, source.metadata, source.attachments, label)


Correction = Callable[[pl.DataFrame], pl.DataFrame]


def corrections(
    calibrations: Sequence[Calibration], channels: Mapping[str, Any]
) -> tuple[dict[str, Correction], dict[str, list[Finding]]]:
    """Return what is done to the tables of raw channels before estimators see them, and what to say of it, by topic.

    A calibration of kind ``imu`` or ``magnetometer`` corrects the channel that its subject names, or, where it
    names none, every channel of its message type.
    """
    steps: dict[str, list[tuple[tuple[str, ...], FloatArray, FloatArray]]] = {}
    findings: dict[str, list[Finding]] = {}
    for one in calibrations:
        for schema, columns, matrix, offset in CORRECTED.get(one.kind, ()):
            if offset not in one.values and matrix not in one.values:
                continue
            m = one.array(matrix) if matrix in one.values else np.eye(3)
            b = one.array(offset) if offset in one.values else np.zeros(3)
            for topic, channel in channels.items():
                if channel.schema != schema or not set(columns) <= set(channel.columns):
                    continue
                if one.subject in ("", topic):
                    steps.setdefault(topic, []).append((columns, m, b))
                    detail = f"{topic}: {columns[0][:3]} corrected by calibration {one.kind} before estimators saw it"
                    findings.setdefault(topic, []).append(Finding("calibrated", 1, None, detail))
    return {topic: _correction(done) for topic, done in steps.items()}, findings


def _correction(steps: Sequence[tuple[tuple[str, ...], FloatArray, FloatArray]]) -> Correction:
    def correct(table: pl.DataFrame) -> pl.DataFrame:
        for columns, matrix, offset in steps:
            values = table.select(columns).to_numpy() - offset
            # one by one: a matrix product of BLAS may round otherwise for another number of rows
            corrected = [
                matrix[i, 0] * values[:, 0] + matrix[i, 1] * values[:, 1] + matrix[i, 2] * values[:, 2]
                for i in range(3)
            ]
            table = table.with_columns(pl.Series(c, v) for c, v in zip(columns, corrected, strict=True))
        return table

    return correct


def calibrations_of_runs(metadata: Mapping[str, Mapping[str, str]]) -> list[Calibration]:
    """Return the calibrations that runs of a recording were given, as its metadata say."""
    texts = {
        value
        for name, record in metadata.items()
        if name.startswith("run/")
        for key, value in record.items()
        if key.startswith("calibration.")
    }
    return [msgspec.json.decode(text, type=Calibration) for text in sorted(texts)]
