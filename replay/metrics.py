"""Figures of merit of one run. Each is a function ``metric(view) -> {name: value}``, an entry point
``marcha.metrics``.

Names carry their units. A metric that does not apply (no reference, length not known) leaves its names out; a
metric that applies but has no value is NaN. ``docs/replay.md`` lists every name with its formula.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import metadata

import numpy as np
import polars as pl

from ..algorithms.contract import FloatArray
from ..recording import rotations
from ..recording.plugins import plugins
from .alignment import IntArray, Transform, match, wrap
from .view import VELOCITY, RunView

Metric = Callable[[RunView], Mapping[str, float]]
BETWEEN = "(between)"
"""How what no interval of a tier covers is called in tables."""


def closure(view: RunView) -> dict[str, float]:
    """Distance from start to end, horizontal (the source's EP, eq 4.3, times the length)."""
    if view.ends is None:
        return {}
    east, north, _ = view.ends[1] - view.ends[0]
    metres = float(np.hypot(east, north))
    metrics = {"closure_m": metres}
    if view.truth.closed and view.truth.length_m:
        metrics["closure_percent"] = 100.0 * metres / view.truth.length_m
    return metrics


def distance(view: RunView) -> dict[str, float]:
    """Way walked, horizontal: from stance to stance (of a phone, the sum of its steps), and along the raw track.

    The source's ED is eq 4.4.
    """
    metrics: dict[str, float] = {}
    steps = view.table("step")
    if steps is not None:
        metrics["steps"] = float(steps.height)
        if view.truth.steps:
            metrics["steps_difference"] = steps.height - view.truth.steps
            metrics["steps_error_percent"] = 100.0 * abs(steps.height - view.truth.steps) / view.truth.steps
    way = view.way
    if way is None:
        return metrics
    if way.stances_m is not None:
        metrics["distance_m"] = way.stances_m
    elif (
        steps is not None and "length_m" in steps.columns and np.isfinite(steps["length_m"].to_numpy()).all()
    ):
        metrics["distance_m"] = float(steps["length_m"].sum())
    metrics["path_m"] = way.length_m
    if (length := view.truth.length_m) is not None:
        if "distance_m" in metrics:
            metrics["distance_difference_m"] = metrics["distance_m"] - length
        for name, metres in (
            ("distance_error_percent", metrics.get("distance_m")),
            ("path_error_percent", metrics["path_m"]),
        ):
            if metres is not None:
                metrics[name] = 100.0 * abs(metres - length) / length
    return metrics


def height(view: RunView) -> dict[str, float]:
    """Height at the end over the start, signed (the source's EA, eq 4.5, is its absolute value)."""
    if view.ends is None:
        return {}
    metrics = {"height_end_m": float(view.ends[1, 2] - view.ends[0, 2])}
    if view.truth.closed:
        metrics["height_error_m"] = abs(metrics["height_end_m"])
    return metrics


def reference(view: RunView) -> dict[str, float]:
    """Errors of position, velocity and heading against the reference, after the view's alignment."""
    compared = view.comparison
    if compared is None:
        return {}
    error = np.linalg.norm(compared.error, axis=1)
    metrics = {
        "ate_rmse_m": float(np.sqrt(np.mean(error**2))),
        "position_error_mean_m": float(error.mean()),
        "position_error_median_m": float(np.median(error)),
        "position_error_p75_m": float(np.percentile(error, 75)),
        "position_error_p95_m": float(np.percentile(error, 95)),
        "position_error_max_m": float(error.max()),
        "position_error_end_m": float(error[-1]),
    }
    if (start := view.compared("origin")) is not None and not view.scattered:
        x, y = np.abs(start.error[-1, :2]).tolist()
        metrics |= {"origin_error_end_x_m": x, "origin_error_end_y_m": y}
    if compared.yaw_error is not None:
        drift = np.degrees(wrap(compared.yaw_error - compared.yaw_start))
        metrics["heading_rmse_deg"] = float(np.sqrt(np.mean(drift**2)))
        metrics["heading_error_end_deg"] = float(drift[-1])
    velocity = _velocity_error(view, compared.transform)
    if velocity is not None:
        metrics["velocity_rmse_m_s"] = float(np.sqrt(np.mean(np.sum(velocity[1] ** 2, axis=1))))
    return metrics


def _velocity_error(view: RunView, transform: Transform) -> tuple[IntArray, FloatArray] | None:
    """Return stamps and velocity errors in the reference's frame where both have velocities."""
    reference = view.reference_velocity
    if reference is None or reference.is_empty():
        return None
    table = view.table("velocity")
    if table is None or table.is_empty():
        return None
    reference = reference.unique("t_ns", keep="first", maintain_order=True)
    t_ns = table["t_ns"].to_numpy()
    pairs = match(t_ns, reference["t_ns"].to_numpy(), view.max_gap_s)
    if not len(pairs.index):
        return None
    ours = transform.vectors(table.select(VELOCITY).to_numpy()[pairs.index])
    return t_ns[pairs.index], ours - pairs.linear(reference.select(VELOCITY).to_numpy())


LEAST_POSITION_SD = 1e-4
"""m: no reference knows a position better; a filter states less just after its start, and that sample is the mean."""


def consistency(view: RunView) -> dict[str, float]:
    """Whether the errors are as large as the filter says: normalized errors from its own standard deviations.

    The track is laid upon the reference at the start (``origin-yaw``), as the filter itself begins with
    certainty there; a fitted alignment would take part of the error away. Samples whose sigma is still 0, or
    below :data:`LEAST_POSITION_SD`, are left out.
    """
    compared = view.compared("origin-yaw")
    if compared is None or not compared.on_estimate or (sigma := view.table("sigma")) is None:
        return {}  # a table of standard deviations is large: it is read where it is needed
    metrics = _normalized(
        sigma,
        "pos",
        "position",
        compared.t_ns,
        compared.error @ compared.transform.rotation,
        least=LEAST_POSITION_SD,
    )
    velocity = _velocity_error(view, compared.transform)
    if velocity is not None:
        t_ns, error = velocity
        metrics |= _normalized(sigma, "vel", "velocity", t_ns, error @ compared.transform.rotation)
    attitude = _attitude_error(view, compared.t_ns, compared.transform)
    if attitude is not None:
        metrics |= _normalized(sigma, "att", "attitude", compared.t_ns, attitude)
        metrics["attitude_rmse_deg"] = float(np.degrees(np.sqrt(np.mean(np.sum(attitude**2, axis=1)))))
    return metrics


SAME_BODY_DEG = 10.0
"""deg: where estimate and reference start farther apart than this, they turn different bodies."""


def _attitude_error(view: RunView, t_ns: IntArray, transform: Transform) -> FloatArray | None:
    """Return attitude errors as small turns about the estimate's own n-axes, rad, shape (n, 3).

    None where a side has no orientation, or where the reference's body is not the sensor's (markers on a shoe, say):
    its constant offset is not known, and fitting it would hide the tilt at the start.
    """
    reference = view.reference_track
    track = None if reference is None else view.track
    if track is None or reference is None or track.quat_wxyz is None or reference.quat_wxyz is None:
        return None
    mine = np.searchsorted(track.t_ns, t_ns)
    right = (
        np.clip(np.searchsorted(reference.t_ns, t_ns), 1, len(reference) - 1)
        if len(reference) > 1
        else mine * 0
    )
    nearer = np.abs(reference.t_ns[right] - t_ns) <= np.abs(t_ns - reference.t_ns[right - 1])
    theirs = np.where(nearer, right, right - 1)
    apart = rotations.product(track.quat_wxyz[mine], rotations.inverse(reference.quat_wxyz[theirs]))
    error = rotations.rotation_vector(rotations.product(apart, rotations.from_matrix(transform.rotation)))
    if np.degrees(np.linalg.norm(error[0])) > SAME_BODY_DEG:
        return None
    return error


def _normalized(
    sigma: pl.DataFrame, part: str, name: str, t_ns: IntArray, error: FloatArray, *, least: float = 0.0
) -> dict[str, float]:
    """Return normalized squared errors; ``error`` is in the estimate's own axes, where sigma is given."""
    columns = [f"sigma_{part}_{a}" for a in "xyz"]
    if not set(columns) <= set(sigma.columns):
        return {}
    _, mine, theirs = np.intersect1d(t_ns, sigma["t_ns"].to_numpy(), return_indices=True)
    sd = sigma.select(columns).to_numpy()[theirs]
    stated = np.isfinite(sd).all(axis=1) & (sd > least).all(axis=1)
    if not stated.any():
        return {}
    ratio = error[mine][stated] / sd[stated]
    squared = np.sum(ratio**2, axis=1)
    return {
        f"nees_{name}": float(squared.mean()),
        f"nees_{name}_end": float(squared[-1]),
        f"within95_{name}_percent": float(100.0 * np.mean(np.abs(ratio) <= 1.959964)),
    }


def nees_bounds(runs: int, dof: int = 3, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval in which the mean normalized squared error of a consistent filter lies.

    Parameters
    ----------
    runs : int
        Number of independent errors that are averaged: runs, not samples of one run (those are correlated).
    dof : int
        Dimension of one error.
    confidence : float
        Probability of the interval, two-sided.

    Returns
    -------
    tuple of float
        From the chi-square distribution with ``runs * dof`` degrees of freedom (Bar-Shalom 2001, eq 5.4.2-4).
    """
    from scipy.stats import chi2

    tail = (1 - confidence) / 2
    low, high = chi2.ppf([tail, 1 - tail], runs * dof) / runs
    return float(low), float(high)


def available_metrics() -> dict[str, Metric]:
    """Return every registered metric by name; a plug-in that does not load is a warning with its name."""
    return {
        n: plugin.part for n, plugin in plugins(metadata.entry_points, "marcha.metrics", "metric").items()
    }
