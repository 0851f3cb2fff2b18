"""A simulated floor as the source's three tables with its plan, and the truth beside them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl

from .floor import ANCHORS, HELD_Z, SIZE_M, FloorWalk, floor_walk
from .together import written_together


def write_floor(
    scenario: str, folder: Path, *, seed: int, name: str | None, overwrite: bool, options: dict[str, Any]
) -> tuple[list[Path], list[Path], FloorWalk]:
    """Write a folder ``<name>`` with the three tables and the plan, and the truth beside it.

    The truth: ``….truth.csv`` (place and attitude in the plan), ``….truth.steps.csv``, ``….truth.toml``.

    Raises
    ------
    UsageError
        Unknown scenario or option.
    OutputExists
        A file is there already.
    """
    walk = floor_walk(scenario, seed=seed, **options)
    stem = name or f"{scenario}-{seed:03d}"
    log = folder / stem
    truths = [folder / f"{stem}.truth{part}" for part in (".csv", ".steps.csv", ".toml")]
    with written_together(folder, (log, *truths), overwrite=overwrite) as part:
        (part / stem).mkdir()
        _tables(part / stem, walk)
        _truth(walk).write_csv(part / truths[0].name)
        walk.phone.steps.with_columns(_headings(walk)).write_csv(part / truths[1].name)
        (part / truths[2].name).write_bytes(msgspec.toml.encode(_facts(walk)))
    return [log], truths, walk


def _tables(folder: Path, walk: FloorWalk) -> None:
    phone = walk.phone
    ms = phone.t_ns // 1_000_000
    readings = {
        "accelerometer": phone.acc_b.round(4),
        "magnetometer": (phone.mag_b * 1e6).round(2),
        "orientation": walk.azimuth_deg.round(2),
    }
    parts = [
        pl.DataFrame({"timestamp": ms, "sensor": [name] * len(ms), "x": v[:, 0], "y": v[:, 1], "z": v[:, 2]})
        for name, v in readings.items()
    ]
    pl.concat(parts).sort("timestamp", maintain_order=True).write_csv(folder / "inertial.csv")
    walk.radio.select(
        timestamp=pl.col("t_ns") // 1_000_000,
        mac="mac",
        rssi=pl.col("rssi_dbm").cast(pl.Int64),
        technology="technology",
        last_seen=pl.col("last_seen_ns") // 1_000_000,
    ).write_csv(folder / "radio.csv")
    rows = [(a.mac, a.p_d0, a.eta, a.x, a.y, a.z, a.technology, a.name) for a in ANCHORS]
    names = ["mac", "rssi at 1 m (dBm)", "eta", "x", "y", "height", "technology", "name"]
    pl.DataFrame(rows, schema=names, orient="row").write_csv(folder / "anchors.csv")
    (folder / "plan.geojson").write_text(
        json.dumps(plan(walk.options.plan_azimuth_deg), indent=1), encoding="utf-8"
    )


ROOMS = {
    "west hall": (0.0, 0.0, 8.0, SIZE_M[1]),
    "corridor": (8.0, 0.0, 17.0, SIZE_M[1]),
    "east hall": (17.0, 0.0, SIZE_M[0], SIZE_M[1]),
}
"""Zones of the floor (lower left and upper right corner, m); the source has none, they are stated here."""


def plan(x_axis_azimuth_deg: float) -> dict[str, Any]:
    """Return the floor as GeoJSON: what can be walked, its outer walls and its zones."""

    def ring(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
        return [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]

    def feature(kind: str, geometry: str, coordinates: Any, **facts: str) -> dict[str, Any]:
        about = {"kind": kind, **facts}
        return {
            "type": "Feature",
            "properties": about,
            "geometry": {"type": geometry, "coordinates": coordinates},
        }

    outside = ring(0.0, 0.0, *SIZE_M)
    features = [feature("passable", "Polygon", [outside]), feature("wall", "LineString", outside)]
    features += [feature("zone", "Polygon", [ring(*corners)], name=name) for name, corners in ROOMS.items()]
    about = {"x_axis_azimuth_deg": x_axis_azimuth_deg, "handedness": "right"}
    return {"type": "FeatureCollection", **about, "features": features}


def _truth(walk: FloorWalk) -> pl.DataFrame:
    phone, xy = walk.phone, walk.position
    columns: dict[str, Any] = {"t_ns": phone.t_ns, "pos_x": xy[:, 0], "pos_y": xy[:, 1]}
    columns |= {"pos_z": np.full(len(xy), HELD_Z)}
    half = np.arctan2(*np.gradient(xy, axis=0)[:, ::-1].T) / 2.0
    columns |= {"quat_w": np.cos(half), "quat_x": 0 * half, "quat_y": 0 * half, "quat_z": np.sin(half)}
    dt = np.gradient((phone.t_ns - phone.t_ns[0]) / 1e9)
    speed = np.gradient(xy, axis=0) / dt[:, None]
    columns |= {"vel_x": speed[:, 0], "vel_y": speed[:, 1], "vel_z": 0 * half}
    return pl.DataFrame(columns | {"still": (~phone.walking).astype(np.int8)})


def _headings(walk: FloorWalk) -> pl.Expr:
    """Return the steps' headings in the plan's frame."""
    turn = np.radians(walk.options.plan_azimuth_deg) + walk.phone.declination_rad - np.pi / 2
    angle = pl.col("heading_rad") + turn
    return pl.arctan2(angle.sin(), angle.cos()).alias("heading_rad")


def _facts(walk: FloorWalk) -> dict[str, Any]:
    phone = walk.phone
    chosen = msgspec.to_builtins(phone.options)
    spread = float(np.hypot(walk.options.shadow_db, walk.options.multipath_db))
    return {
        "closed": phone.closed,
        **({"length_m": round(phone.length_m, 6)} if phone.length_m else {}),
        **({"steps": phone.steps.height} if phone.steps.height else {}),
        "scenario": phone.scenario,
        "seed": phone.seed,
        "format": "three-tables",
        "frame": "plan",
        "sigma_db": round(spread, 4),
        "floor": {k: v for k, v in msgspec.to_builtins(walk.options).items() if v is not None},
        "options": {k: v for k, v in chosen.items() if v is not None},
    }
