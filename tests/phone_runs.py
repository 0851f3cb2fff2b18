"""A phone's estimator over a simulated walk, without files: messages of all sensors in the order of time."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import polars as pl
from marcha.algorithms import make
from marcha.algorithms.contract import ChannelInfo, Context, KernelEstimator
from marcha.ingest.simulate import PhoneWalk, phone_walk
from marcha.replay.metrics_place import Plane, stated_covariances

FIXES = ("lat_deg", "lon_deg", "alt_m", "sd_east_m", "sd_north_m", "sd_up_m")
PLACEMENTS = ("hand", "pocket", "bag", "armband", "neck", "swinging")
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


def sensor_tables(walk: PhoneWalk, *, velocity: bool = False) -> dict[str, pl.DataFrame]:
    """Return what each input of a phone's estimator is served with; ``velocity``: the receiver's, too."""
    moving = walk.fixes.select("t_ns", vel_x="vel_east", vel_y="vel_north")
    t_ns = pl.Series("t_ns", walk.t_ns)

    def table(name: str, values: np.ndarray) -> pl.DataFrame:
        return pl.DataFrame([t_ns, *(pl.Series(f"{name}_{a}", values[:, i]) for i, a in enumerate("xyz"))])

    return {
        "acc": table("acc", walk.acc_b),
        "gyr": table("gyr", walk.gyr_b),
        "mag": table("mag", walk.mag_b),
        "pressure": walk.pressure,
        "gnss": walk.fixes.select("t_ns", *FIXES).with_columns(status=pl.lit(0)),
        "velocity": moving if velocity else moving.clear(),
    }


def run_phone(name: str, tables: dict[str, pl.DataFrame], **params: Any) -> dict[str, pl.DataFrame]:
    """Return the results of a kernel estimator by output, ``t_ns`` first; all inputs are attached."""
    estimator: Any = make(name, **params)
    assert isinstance(estimator, KernelEstimator)
    attached, parts = {}, []
    for index, one in enumerate(estimator.inputs):
        table = tables[one.name]
        if not table.height:
            continue
        t = table["t_ns"].to_numpy()
        rate = 1e9 * (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else 0.0
        columns = tuple(c for c in table.columns if c != "t_ns")
        attached[one.name] = (ChannelInfo(f"/phone/{one.name}", one.schema, columns=columns, rate_hz=rate),)
        parts.append((index, t, estimator.encode(index, 0, table)))
    estimator.start(Context(channels=attached))
    width = max(v.shape[1] for _, _, v in parts)
    values = np.concatenate(
        [np.pad(v, ((0, 0), (0, width - v.shape[1])), constant_values=np.nan) for *_, v in parts]
    )
    inputs = np.concatenate([np.full(len(t), i) for i, t, _ in parts])
    times = np.concatenate([t for _, t, _ in parts])
    order = np.argsort(times, kind="stable")
    room = 16 * len(times) // 4 + 64
    whose, when, out = (
        np.zeros(room, np.int64),
        np.zeros(room, np.int64),
        np.full((room, estimator.width), np.nan),
    )
    n = estimator.run(
        estimator.state,
        inputs[order],
        np.zeros(len(times), np.int64),
        times[order],
        values[order],
        whose,
        when,
        out,
    )
    last_t, last = estimator.held()
    t_ns, rows = np.concatenate((when[:n], last_t)), np.concatenate((out[:n], last))
    found, first = {}, 0
    for output in estimator.outputs:
        part = rows[:, first : first + len(output.columns)]
        first += len(output.columns)
        said = ~np.isnan(part[:, 0]) if output.event else ~np.isnan(part).all(axis=1)
        columns = dict(zip(output.columns, part[said].T, strict=True))
        found[output.name] = pl.DataFrame({"t_ns": t_ns[said], **columns})
    return found


def fused(walk: PhoneWalk, *, velocity: bool = False) -> Places:
    """Return times (s), errors (n, 2) in metres, and covariances (n, 2, 2) that ``phone.fused`` states."""
    out = run_phone("phone.fused", sensor_tables(walk, velocity=velocity))
    fix = out["fix"]
    t = fix["t_ns"].to_numpy() - walk.t_ns[0]
    place = Plane(walk.options.lat_deg, walk.options.lon_deg)(fix)
    true = np.column_stack([np.interp(t, walk.t_ns - walk.t_ns[0], walk.pos[:, i]) for i in range(2)])
    return t * 1e-9, place - true, stated_covariances(fix, out["state"])


@cache
def carried(seed: int, scenario: str = "phone-100m", *, velocity: bool = False) -> Places:
    """Return :func:`fused` of a walk whose placement, course and gait the seed draws."""
    rng = np.random.default_rng(seed)
    options: dict[str, Any] = {
        "placement": PLACEMENTS[seed % 6],
        "course_deg": float(rng.uniform(0, 360)),
        "step_m": float(rng.uniform(0.6, 0.8)),
        "step_s": float(rng.uniform(0.5, 0.6)),
    }
    return fused(phone_walk(scenario, seed=seed, rate_hz=25, pressure_hz=0, **options), velocity=velocity)
