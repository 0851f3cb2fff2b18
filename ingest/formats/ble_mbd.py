"""BLE packets that receivers of known position heard from a moving beacon, with its optical position.

``.mbd`` rows are ``epoch_s,receiver,beacon,rssi`` and, on a track, ``x,y,z`` and a rotation matrix by rows
(optical, m). The receivers stand in a ``.dev`` file (``Dongles:{address: [[x, y, z], colour, name]}``), found
beside the log or above it. Calibration files have no position columns; their names say the place:
``<receiver>_<x>_<y>_<z>.mbd``. A folder of them is one recording.

The receivers are the anchors: ``mac`` of a power is the receiver that heard it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ...recording.codec import MAX_TIME_NS, SECOND
from ...recording.errors import MarchaError, UsageError
from ...recording.rotations import QUAT
from ..contract import ChannelSpec, CommonOptions, Import, ReportBuilder
from ..radio import RADIO, REFERENCE, address, anchor_table, ordered, survey
from ..text import BOM, read_text, text_lines

POSE = "geometry_msgs/msg/PoseStamped"
_ROW = re.compile(rb"^\d{9,10}(\.\d+)?,[0-9a-fA-F]{12},[0-9a-fA-F]{12},-?\d+")
_PLACE = re.compile(r"^(?P<receiver>[^_]+)_(?P<x>-?\d+(\.\d+)?)_(?P<y>-?\d+(\.\d+)?)_(?P<z>-?\d+(\.\d+)?)$")
ROWS = 65_536
"""Rows whose poses are made together."""


class MbdOptions(CommonOptions, frozen=True, kw_only=True):
    """Where the receivers stand.

    Attributes
    ----------
    devices : str, optional
        Path of the ``.dev`` file; default: the one in the log's folder or the folder above.
    """

    devices: Annotated[
        str | None, msgspec.Meta(description="table of receivers (.dev); default: beside the log or above it")
    ] = None


class BleMbd:
    """Importer ``ble-mbd``: ``/indoor/radio`` and the beacon's ``/reference/pose`` or ``/reference/position``."""

    name: ClassVar[str] = "ble-mbd"
    title: ClassVar[str] = (
        "BLE packets of a moving beacon at known receivers (.mbd, .dev), with optical truth"
    )
    Options = MbdOptions
    joins: ClassVar[bool] = True
    folders: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of epoch, two addresses and a power; a folder whose files all say their place."""
        if path.is_dir():
            files = list(path.glob("*.mbd"))
            return 0.9 if files and all(_PLACE.match(f.stem) for f in files) else 0.0
        return 0.95 if _ROW.match(head.removeprefix(BOM)) else 0.0

    def read(self, paths: Sequence[Path], options: MbdOptions) -> Import:
        """Read one track, or calibration files together."""
        files = [f for p in paths for f in (sorted(p.glob("*.mbd")) if p.is_dir() else [p])]
        if not files:
            raise MarchaError(f"{paths[0]}: the folder has no .mbd file")
        report = ReportBuilder()
        device_file = _device_file(files[0], options.devices)
        devices = _devices(device_file)
        parts = [_parse(f, report) for f in files]
        static = [len(p.columns) == 4 for p in parts]
        if any(static) != all(static):
            raise UsageError(
                f"{files[0]}: tracks and calibration files do not go into one recording; convert each"
            )
        tables: dict[str, Iterable[pl.DataFrame]] = {}
        if static[0]:
            stretches = [(f, p) for f, p in zip(files, parts, strict=True) if p.height]
            points = [(p["t_ns"].min(), p["t_ns"].max(), _place(f, devices, p)) for f, p in stretches]
            points, parts = _apart(stretches, points, report)
            tables[REFERENCE.topic] = [survey(points)]
        elif len(files) > 1:
            raise UsageError(f"{files[0]}: {len(files)} tracks; convert them one by one")
        whole = ordered(pl.concat(parts), files[0].name, report)
        del parts
        report.keep(whole.height)
        beacons = sorted(whole["beacon"].unique().to_list())
        specs: list[ChannelSpec] = []
        for k, beacon in enumerate(beacons):
            mine = whole if len(beacons) == 1 else whole.filter(pl.col("beacon") == beacon)
            topic = "/indoor/radio" if len(beacons) == 1 else f"/indoor/beacon{k + 1}/radio"
            tables[topic] = [mine.select("t_ns", "mac", "rssi_dbm", technology=pl.lit("ble"))]
            specs.append(ChannelSpec(topic, RADIO, "plan", metadata={"beacon": beacon, "mac": "receiver"}))
            if not static[0]:
                reference = "/reference/pose" if len(beacons) == 1 else f"/reference/beacon{k + 1}/pose"
                tables[reference] = _poses(mine, report)
                specs.append(ChannelSpec(reference, POSE, "plan", metadata={"beacon": beacon}))
        if static[0]:
            specs.append(REFERENCE)
        return Import(
            channels=specs,
            blocks=((topic, table) for topic, parts in tables.items() for table in parts),
            report=report,
            metadata={
                "device": {
                    "clock": "unix",
                    "name": f"BLE receivers, beacon {' '.join(beacons[:4])}",
                    "time": "column 1, seconds",
                },
                "plan": {"handedness": "right", "frame": "x, y, z of the optical system, m"},
            },
            also_read=[device_file],
            attachments=[
                anchor_table(
                    {"mac": mac, "technology": "ble", "x": x, "y": y, "z": z, "name": name}
                    for mac, ((x, y, z), name) in devices.items()
                )
            ],
        )


def _parse(path: Path, report: ReportBuilder) -> pl.DataFrame:
    """Return t_ns, mac, beacon, rssi_dbm and, on a track, x y z r00 … r22."""
    parts: list[pl.DataFrame] = []
    width = 0
    for first, lines in text_lines(path):
        good: list[list[str]] = []
        for line, row in enumerate(lines, first):
            if not row.strip():
                continue
            cells = row.split(",")
            matches = _ROW.match(row.encode()) is not None
            if not width and len(cells) in (4, 16) and matches:
                width = len(cells)
            if len(cells) == width and matches and _numbers(cells[3:]):
                if float(cells[0]) * SECOND <= MAX_TIME_NS:
                    good.append(cells)
                else:
                    report.drop(
                        "bad_row", f"{path.name}: {row[:40]!r}: time beyond any clock; dropped", line=line
                    )
                continue
            if not width:
                raise MarchaError(
                    f"{path}, line {line}: not epoch_s,receiver,beacon,rssi[,x,y,z,R]: {row[:30]!r}"
                )
            report.drop(
                "bad_row", f"{path.name}: {row[:40]!r}: not a row of {width} cells; dropped", line=line
            )
        if good:
            parts.append(_table(good))
    if not parts:
        raise MarchaError(f"{path}: no row epoch_s,receiver,beacon,rssi; nothing to convert")
    return pl.concat(parts)


def _table(rows: Sequence[Sequence[str]]) -> pl.DataFrame:
    # Whole and fractional seconds apart: an epoch in nanoseconds does not fit a float.
    whole = [c[0].partition(".") for c in rows]
    columns: dict[str, Any] = {
        "t_ns": [int(s) * SECOND + int((f + "0" * 9)[:9]) for s, _, f in whole],
        "mac": [address(c[1]) for c in rows],
        "beacon": [address(c[2]) for c in rows],
    }
    values = np.array([c[3:] for c in rows], dtype=np.float64)
    names = ("rssi_dbm", *(f"v{i}" for i in range(values.shape[1] - 1)))
    return pl.DataFrame(
        columns | {n: values[:, i] for i, n in enumerate(names)}, schema_overrides={"t_ns": pl.Int64}
    )


def _numbers(cells: Sequence[str]) -> bool:
    try:
        return bool(np.isfinite([float(c) for c in cells]).all())
    except ValueError:
        return False


def _poses(track: pl.DataFrame, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    """Yield the optical poses; a matrix is projected to the nearest rotation."""
    from scipy.spatial.transform import Rotation

    for first in track.unique("t_ns", keep="first", maintain_order=True).iter_slices(ROWS):
        matrices = first.select(f"v{i}" for i in range(3, 12)).to_numpy().reshape(-1, 3, 3)
        u, s, vt = np.linalg.svd(matrices)
        flip = np.ones((len(u), 3))
        flip[:, 2] = np.sign(np.linalg.det(u @ vt))
        rotations = (u * flip[:, None, :]) @ vt
        rough = np.abs(s - 1).max(axis=1) > 0.05
        if rough.any():
            report.note(
                "rough_rotation", "rotation matrices off orthogonal by more than 5 %", count=int(rough.sum())
            )
        xyzw = Rotation.from_matrix(rotations).as_quat()
        yield first.select("t_ns", pos_x="v0", pos_y="v1", pos_z="v2").with_columns(
            **{n: pl.Series(xyzw[:, i]) for n, i in zip(QUAT, (3, 0, 1, 2), strict=True)}
        )


def _place(
    path: Path, devices: dict[str, tuple[list[float], str]], part: pl.DataFrame
) -> tuple[float, float, float]:
    match = _PLACE.match(path.stem)
    if not match:
        raise MarchaError(
            f"{path}: rows without position, and the name does not say it: <receiver>_<x>_<y>_<z>.mbd, in metres"
        )
    names = {devices[m][1] for m in part["mac"].unique() if m in devices}
    if names and names != {match["receiver"]}:
        raise MarchaError(
            f"{path}: named for {match['receiver']}, but heard by {', '.join(sorted(names))}; rename it"
        )
    return float(match["x"]), float(match["y"]), float(match["z"])


def _apart(
    stretches: Sequence[tuple[Path, pl.DataFrame]],
    points: Sequence[tuple[Any, Any, Sequence[float]]],
    report: ReportBuilder,
) -> tuple[list[tuple[int, int, Sequence[float]]], list[pl.DataFrame]]:
    """Return survey points and tables one after another; those that overlap another place in time are moved."""
    order = sorted(range(len(points)), key=lambda i: points[i][0])
    kept: list[tuple[int, int, Sequence[float]]] = []
    tables: list[pl.DataFrame] = []
    moved, end = 0, -1
    for i in order:
        first, last, where = points[i]
        shift = 0
        if kept and first <= end:
            if where == kept[-1][2] and last <= end:
                tables.append(stretches[i][1])
                continue
            shift = end + 1_000_000_000 - first
            moved += 1
        kept.append((first + shift, last + shift, where))
        tables.append(stretches[i][1].with_columns(pl.col("t_ns") + shift))
        end = last + shift
    if moved:
        report.repair(
            "overlapping_stretches",
            "calibration files of different places overlap in time: laid one after another",
            count=moved,
        )
    return kept, tables


def _device_file(log: Path, named: str | None) -> Path:
    """Return the table of receivers that belongs to a log."""
    if named is not None:
        return Path(named)
    tables = next((f for d in (log.parent, log.parent.parent) for f in [sorted(d.glob("*.dev"))] if f), [])
    if len(tables) != 1:
        raise UsageError(
            f"{log}: {len(tables) or 'no'} table of receivers (.dev) beside it; name it with devices=FILE.dev"
        )
    return tables[0]


def _devices(file: Path) -> dict[str, tuple[list[float], str]]:
    """Return address to position and name of the receivers."""
    match = re.search(r"Dongles:\s*(\{.*?\})\s*(Beacons:|$)", read_text(file), re.DOTALL)
    try:
        table = json.loads(match[1]) if match else None
    except (ValueError, RecursionError) as error:
        raise MarchaError(f"{file}: Dongles is not JSON: {error}") from error
    if not table:
        raise MarchaError(f"{file}: no 'Dongles:{{address: [[x, y, z], colour, name]}}'")
    devices: dict[str, tuple[list[float], str]] = {}
    for mac, about in table.items():
        try:
            x, y, z = map(float, about[0][:3])
            devices[address(mac)] = ([x, y, z], str(about[2]))
        except (TypeError, ValueError, IndexError, KeyError, OverflowError) as error:
            raise MarchaError(f"{file}: receiver {mac}: not [[x, y, z], colour, name]") from error
    return devices
