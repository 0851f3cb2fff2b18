"""Exoskeleton captures: one CSV of inertial sensors on segments and encoders in joints, with a TOML mapping.

The mapping names columns, units, segments, sides and frames (``docs/formats.md``). A mounting rotation is applied:
readings then are in the segment's axes, x to the right (the flexion axis of the source), y forward, z up.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ...recording.files import read_toml
from ..contract import CommonOptions, Import, ReportBuilder
from ..leg import IMU, JOINTS, MAG, FloatArray
from ..legchecks import unwrapped
from ..mapping import CellSource, Mapping, Strict, TextLayout, Time, Topic
from .table import open_table

AXES = "xyz"
ENCODER = "/leg/encoder"
_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z][\w-]*$")]
Vector = tuple[float, float, float]


class Segment(Strict, frozen=True, kw_only=True):
    """One segment and its sensor.

    Attributes
    ----------
    prefix : str
        Columns are ``<prefix>_acc_x`` …; default the segment's name.
    acc, gyr, mag : list of str or int
        Columns of x, y, z where they are named otherwise (or numbers from 1).
    side : str
        ``left`` or ``right``.
    mounting_wxyz : list of float
        Rotation that takes the sensor's axes to the segment's (quaternion).
    mounting_deg : list of float
        The same as turns about x, then y, then z of the segment (degrees); give the one or the other.
    flexion_axis : list of float
        In the segment's axes; default x.
    units : dict of str to str
        Of this segment, where they differ.
    """

    prefix: str | None = None
    acc: tuple[str | int, str | int, str | int] | None = None
    gyr: tuple[str | int, str | int, str | int] | None = None
    mag: tuple[str | int, str | int, str | int] | None = None
    side: Literal["left", "right"] | None = None
    mounting_wxyz: tuple[float, float, float, float] | None = None
    mounting_deg: Vector | None = None
    flexion_axis: Vector = (1.0, 0.0, 0.0)
    units: dict[str, str] = msgspec.field(default_factory=dict)


class EncoderColumn(Strict, frozen=True, kw_only=True):
    """One joint with an encoder: angle = sign · (reading − zero).

    Attributes
    ----------
    column : str or int
        Default ``<joint>_enc``.
    upper, lower : str
        Names of the segments; the angle is that of the upper less that of the lower one about the flexion axis.
    unit : str
        Of the column; default ``units.enc``.
    sign : int
        1, or -1 where the encoder counts the other way.
    zero : float
        Reading at an angle of zero, in its unit.
    """

    upper: str
    lower: str
    column: str | int | None = None
    unit: str | None = None
    sign: Literal[1, -1] = 1
    zero: float = 0.0


class ExoMapping(Strict, frozen=True, kw_only=True):
    """A whole mapping; ``time`` and ``layout`` as in a table's."""

    segment: dict[_Name, Segment]
    joint: dict[_Name, EncoderColumn] = msgspec.field(default_factory=dict)
    time: Time = Time(column="time")
    layout: TextLayout = TextLayout()
    units: dict[str, str]
    device: dict[str, str] = msgspec.field(default_factory=dict)


class ExoOptions(CommonOptions, frozen=True, kw_only=True):
    """The mapping file (``--map``).

    Attributes
    ----------
    mapping : str or None
        Path of the TOML file; default the file's own name with ``.toml``.
    """

    mapping: Annotated[
        str | None, msgspec.Meta(description="TOML mapping (--map); default: the file's name with .toml")
    ] = None


class ExoCsv:
    """Importer ``exo-csv``: ``/leg/<segment>/imu``, ``/leg/<segment>/mag`` and ``/leg/encoder``."""

    name: ClassVar[str] = "exo-csv"
    title: ClassVar[str] = "exoskeleton capture: CSV of segments and encoders with a TOML mapping"
    Options = ExoOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A table beside which a mapping of segments stands."""
        beside = path.with_suffix(".toml")
        if path.suffix.lower() not in (".csv", ".txt", ".tsv") or not beside.is_file():
            return 0.0
        try:
            mapping: ExoMapping = read_toml(beside, ExoMapping)
        except MarchaError:
            return 0.0
        first = head[:4096].decode("utf-8", "replace")
        return 0.9 if any((s.prefix or name) in first for name, s in mapping.segment.items()) else 0.0

    def read(self, paths: Sequence[Path], options: ExoOptions) -> Import:
        """Read one file."""
        path = paths[0]
        if not path.is_file():
            raise MarchaError(f"{path}: no such file")
        map_file = Path(options.mapping) if options.mapping else path.with_suffix(".toml")
        mapping = _read_mapping(map_file, path)
        turns = {name: _mounting(map_file, name, s) for name, s in mapping.segment.items()}
        report = ReportBuilder()
        specs, blocks = open_table(path, _table(map_file, mapping), map_file, report)
        by_topic = {f"/leg/{name}/{what}": turn for name, turn in turns.items() for what in ("imu", "mag")}
        return Import(
            channels=specs,
            blocks=unwrapped(_turned(blocks, by_topic), [ENCODER], report),
            report=report,
            metadata={
                "device": {"clock": mapping.time.clock, **mapping.device},
                "mapping": {"file": map_file.name, "toml": map_file.read_text(encoding="utf-8")},
            },
            also_read=[map_file],
        )


def _read_mapping(map_file: Path, path: Path) -> ExoMapping:
    if not map_file.exists():
        raise MarchaError(
            f"{map_file}: no such mapping file; {path.name} needs one that names segments and units (--map)"
        )
    mapping: ExoMapping = read_toml(map_file, ExoMapping)
    if not mapping.segment:
        raise MarchaError(f"{map_file}: segment: at least one segment is needed")
    for name, joint in mapping.joint.items():
        for end in (joint.upper, joint.lower):
            if end not in mapping.segment:
                segments = ", ".join(mapping.segment)
                raise MarchaError(
                    f"{map_file}: joint.{name}: {end!r} is no segment of it; there are {segments}"
                )
        if joint.upper == joint.lower:
            raise MarchaError(f"{map_file}: joint.{name}: upper and lower are both {joint.upper!r}")
    return mapping


def _table(map_file: Path, mapping: ExoMapping) -> Mapping:
    """Return the same as a table's mapping."""
    topics = []
    for name, segment in mapping.segment.items():
        units = mapping.units | segment.units
        prefix = segment.prefix or name
        named = {
            kind: getattr(segment, kind) or tuple(f"{prefix}_{kind}_{a}" for a in AXES)
            for kind in ("acc", "gyr")
        }
        for kind in (*named, *(["mag"] if segment.mag else [])):
            if kind not in units:
                raise MarchaError(f"{map_file}: units.{kind}: missing; say the unit of {prefix}_{kind}_x")
        metadata = {
            "flexion_axis": _text(segment.flexion_axis),
            **({"side": segment.side} if segment.side else {}),
        }
        frame = f"{name}_imu"
        if segment.mounting_wxyz is not None or segment.mounting_deg is not None:
            frame = name
            metadata |= {"axes": "segment", "mounting_wxyz": _text(_quat(segment))}
        columns: dict[str, CellSource | str | int] = {
            f"{kind}_{a}": c for kind, cells in named.items() for a, c in zip(AXES, cells, strict=True)
        }
        topics.append(
            Topic(
                name=f"/leg/{name}/imu",
                schema=IMU,
                columns=columns,
                units=units,
                frame=frame,
                metadata=metadata,
            )
        )
        if segment.mag:
            columns = {f"mag_{a}": c for a, c in zip(AXES, segment.mag, strict=True)}
            topics.append(
                Topic(name=f"/leg/{name}/mag", schema=MAG, columns=columns, units=units, frame=frame)
            )
    if mapping.joint:
        topics.append(_encoders(map_file, mapping))
    return Mapping(topic=topics, time=mapping.time, layout=mapping.layout)


def _encoders(map_file: Path, mapping: ExoMapping) -> Topic:
    columns: dict[str, CellSource | str | int] = {}
    metadata: dict[str, str] = {}
    for name, joint in mapping.joint.items():
        unit = joint.unit or mapping.units.get("enc")
        if unit not in ("deg", "rad", "°"):
            raise MarchaError(
                f"{map_file}: joint.{name}.unit: {unit!r} is neither 'deg' nor 'rad' (units.enc)"
            )
        rad = 1.0 if unit == "rad" else np.pi / 180
        columns[name] = CellSource(
            column=f"{name}_enc" if joint.column is None else joint.column,
            unit=unit,
            scale=float(joint.sign),
            offset=-joint.sign * joint.zero * rad,
        )
        axis = mapping.segment[joint.upper].flexion_axis
        metadata |= {f"{name}.upper": joint.upper, f"{name}.lower": joint.lower}
        mounted = [mapping.segment[s] for s in (joint.upper, joint.lower)]
        if all(s.mounting_wxyz is not None or s.mounting_deg is not None for s in mounted):
            metadata[f"{name}.axis"] = _text(axis)
    return Topic(name=ENCODER, schema=JOINTS, columns=columns, metadata=metadata)


def _quat(segment: Segment) -> tuple[float, float, float, float]:
    from scipy.spatial.transform import Rotation

    if segment.mounting_wxyz is not None:
        return segment.mounting_wxyz
    assert segment.mounting_deg is not None
    x, y, z, w = Rotation.from_euler("xyz", segment.mounting_deg, degrees=True).as_quat(canonical=True)
    return float(w), float(x), float(y), float(z)


def _mounting(map_file: Path, name: str, segment: Segment) -> FloatArray | None:
    """Return ``rot_sb`` of a segment whose mounting is known."""
    from scipy.spatial.transform import Rotation

    if segment.mounting_wxyz is None and segment.mounting_deg is None:
        return None
    if segment.mounting_wxyz is not None and segment.mounting_deg is not None:
        raise MarchaError(f"{map_file}: segment.{name}: give mounting_wxyz or mounting_deg, not both")
    quat = np.array(_quat(segment))
    if abs(np.linalg.norm(quat) - 1) > 0.01:
        norm = np.linalg.norm(quat)
        raise MarchaError(f"{map_file}: segment.{name}.mounting_wxyz: its norm is {norm:.3g}, not 1")
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()


def _turned(
    blocks: Iterable[tuple[str, pl.DataFrame]],
    turns: dict[str, FloatArray | None],
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks, vectors of mounted sensors in the axes of their segments."""
    for topic, table in blocks:
        turn = turns.get(topic)
        if turn is not None:
            for kind in ("acc", "gyr", "mag"):
                names = [f"{kind}_{a}" for a in AXES]
                if names[0] in table.columns:
                    moved = table.select(names).to_numpy() @ turn.T
                    table = table.with_columns(pl.Series(n, moved[:, k]) for k, n in enumerate(names))
        yield topic, table


def _text(values: Sequence[float]) -> str:
    return " ".join(f"{v:.12g}" for v in values)
