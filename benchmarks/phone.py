"""Phones: an hour at 100 Hz through steps, attitude, track and fusion; real sets beside ``polars.read_csv``."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.algorithms import make
from marcha.algorithms.contract import ChannelInfo, Context
from marcha.ingest import convert
from marcha.ingest.simulate import phone_walk

from . import Row
from .replay import _best

CHAIN = ("phone.steps", "phone.attitude", "phone.pdr", "phone.fused")
BLOCK = 8192
SECONDS = 3600
CHAIN_S, CONVERT_TIMES = 2.0, 4.0
DATA = Path(os.environ.get("MARCHA_DATA", Path(__file__).parents[2] / "shared" / "data")) / "phone"
SETS = {"androsensor": "androsensor/Sensor_record_20151030_101942_AndroSensor.csv", "phyphox": "phyphox"}


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` 1 takes an hour."""
    seconds = max(60, int(SECONDS * scale))
    tables = _hour(seconds)
    ours = _best(lambda: [_run(name, tables) for name in CHAIN])
    vqf = _best(lambda: _vqf(tables))
    limit = CHAIN_S * seconds / SECONDS
    found = [
        Row(
            f"phone: {seconds} s at 100 Hz through {', '.join(CHAIN)}", ours, "s", "vqf (C++), orientation only", vqf,
            ours / vqf, f"≤ {limit:.2g} s", ours <= limit,
        )
    ]  # fmt: skip
    return found + [
        _conversion(name, DATA / where) for name, where in SETS.items() if (DATA / where).exists()
    ]


def _hour(seconds: int) -> dict[str, pl.DataFrame]:
    """Return what a phone's sensors say, a short walk over and over."""
    walk = phone_walk("phone-100m", seed=1, rate_hz=100, pressure_hz=1)
    span = int(walk.t_ns[-1] - walk.t_ns[0]) + 10_000_000
    times = -(-seconds * 10**9 // span)

    def repeated(t_ns: Any, columns: dict[str, Any]) -> pl.DataFrame:
        t = np.concatenate([np.asarray(t_ns) + k * span for k in range(times)])
        keep = t < walk.t_ns[0] + seconds * 10**9
        return pl.DataFrame({"t_ns": t[keep], **{c: np.tile(v, times)[keep] for c, v in columns.items()}})

    def vectors(name: str, values: Any) -> pl.DataFrame:
        return repeated(walk.t_ns, {f"{name}_{a}": values[:, i] for i, a in enumerate("xyz")})

    fixes = {c: walk.fixes[c].to_numpy() for c in ("lat_deg", "lon_deg", "alt_m", "sd_east_m", "sd_north_m")}
    return {
        "acc": vectors("acc", walk.acc_b),
        "gyr": vectors("gyr", walk.gyr_b),
        "mag": vectors("mag", walk.mag_b),
        "pressure": repeated(walk.pressure["t_ns"], {"pressure_pa": walk.pressure["pressure_pa"].to_numpy()}),
        "gnss": repeated(walk.fixes["t_ns"], fixes),
        "velocity": repeated(
            walk.fixes["t_ns"],
            {f"vel_{a}": walk.fixes[f"vel_{b}"] for a, b in (("x", "east"), ("y", "north"))},
        ),
    }


def _run(name: str, tables: dict[str, pl.DataFrame]) -> int:
    """Feed one kernel in blocks, as the engine does; return its number of results."""
    estimator: Any = make(name)
    attached = {
        one.name: (
            ChannelInfo(
                f"/phone/{one.name}", one.schema, columns=tuple(tables[one.name].columns[1:]), rate_hz=100.0
            ),
        )
        for one in estimator.inputs
    }
    estimator.start(Context(channels=attached))
    parts = [(i, estimator.encode(i, 0, tables[one.name])) for i, one in enumerate(estimator.inputs)]
    width = max(v.shape[1] for _, v in parts)
    values = np.concatenate(
        [np.pad(v, ((0, 0), (0, width - v.shape[1])), constant_values=np.nan) for _, v in parts]
    )
    inputs = np.concatenate([np.full(len(v), i) for i, v in parts])
    times = np.concatenate([tables[one.name]["t_ns"].to_numpy() for one in estimator.inputs])
    order = np.argsort(times, kind="stable")
    values, inputs, times = values[order], inputs[order], times[order]
    room = BLOCK * estimator.max_results
    whose, when, out = (
        np.zeros(room, np.int64),
        np.zeros(room, np.int64),
        np.full((room, estimator.width), np.nan),
    )
    channels, count = np.zeros(BLOCK, np.int64), 0
    for a in range(0, len(times), BLOCK):
        b = min(a + BLOCK, len(times))
        count += estimator.run(
            estimator.state, inputs[a:b], channels[: b - a], times[a:b], values[a:b], whose, when, out
        )
    return count


def _vqf(tables: dict[str, pl.DataFrame]) -> None:
    from vqf import VQF

    VQF(0.01).updateBatch(
        *(np.ascontiguousarray(tables[k].drop("t_ns").to_numpy()) for k in ("gyr", "acc", "mag"))
    )


def _conversion(name: str, path: Path) -> Row:
    """Convert a real set, beside reading the same files as they are."""
    files = [path] if path.is_file() else sorted(path.glob("*.csv"))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "x.mcap")
        ours = _best(lambda: convert(path, out, overwrite=True))
        assert mr.open(out).channels
    theirs = _best(lambda: [_read(f) for f in files])
    return Row(
        f"convert {name} (one process, warm)", ours, "s", "polars.read_csv", theirs, ours / theirs,
        f"≤ {CONVERT_TIMES:g} × polars", ours <= CONVERT_TIMES * theirs,
    )  # fmt: skip


def _read(path: Path) -> pl.DataFrame:
    separator = ";" if b";" in path.read_bytes()[:200] else ","
    return pl.read_csv(
        path, separator=separator, infer_schema_length=1000, ignore_errors=True, encoding="utf8-lossy"
    )
