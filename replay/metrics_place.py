"""Figures of tracks on the Earth: beside fixes of the same time, a survey of another time, withheld fixes.

Distances are horizontal, in metres of the tangent plane at the first place compared; nothing is aligned but where
a name says so. What a run states of itself (``fix``: latitude, longitude, deviations; ``state``: correlation) is
measured beside its errors.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import AlgorithmError, FloatArray
from ..algorithms.phone.horn import horn
from .alignment import IntArray, match
from .trajectory import stepwise, track_of

if TYPE_CHECKING:
    from scipy.spatial import KDTree

    from .view import RunView

ELLIPSE95 = 5.991464547107979
"""95 % quantile of the chi-square distribution with two degrees of freedom."""
REFERENCE_GAP_S = 2.5
"""Fixes of a reference farther apart are not interpolated between."""
LINE_GAP_M = 20.0
"""Places of a survey farther apart are not joined: nobody knows how the route went there."""
PIECE_M = 1.0
"""Longest piece of a survey's line; longer ones are cut, so that a tree of their middles finds the nearest."""
END_M = 2.0
SHAPE_ROUNDS = 60


@dataclass(frozen=True)
class Places:
    """Where a run says that it was, in a tangent plane.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
        Ascending.
    xy : ndarray, shape (n, 2)
        East, north (m).
    cov : ndarray, shape (n, 2, 2)
        What the run states of their errors (m²); NaN where it states nothing.
    """

    t_ns: IntArray
    xy: FloatArray
    cov: FloatArray


class Plane:
    """The tangent plane at a place on WGS 84: east and north in metres, by PROJ."""

    def __init__(self, lat_deg: float, lon_deg: float) -> None:
        from pyproj import Transformer

        self._transform = Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={lat_deg!r} +lon_0={lon_deg!r} +h_0=0"
        )

    def __call__(self, table: pl.DataFrame) -> FloatArray:
        """Return east and north of ``lat_deg, lon_deg``, shape (n, 2)."""
        lat, lon = table["lat_deg"].to_numpy(), table["lon_deg"].to_numpy()
        east, north, _ = self._transform.transform(lon, lat, np.zeros(len(lat)))
        return np.column_stack((east, north))


def places(view: RunView) -> dict[str, float]:
    """Errors of a run's places (``fix``) against fixes of a reference, a survey's line, withheld fixes."""
    ours = usable(view.table("fix"))
    if ours is None:
        return waypoint_ellipse(view) | _radius(_local_covariances(view))
    plane = Plane(ours["lat_deg"][0], ours["lon_deg"][0])
    track = Places(ours["t_ns"].to_numpy(), plane(ours), stated_covariances(ours, view.table("state")))
    raw = _raw_fixes(view)
    metrics = _radius(track.cov)
    reference = usable(view.reference_table("fix")) if view.recording is not None else None
    survey = usable(view.survey)
    if reference is not None:
        there = reference["t_ns"].to_numpy()
        if there[0] <= track.t_ns[-1] and track.t_ns[0] <= there[-1]:
            metrics |= _beside(track, there, plane(reference), "fix_error")
            if raw is not None:
                metrics |= _errors(
                    _against(raw["t_ns"].to_numpy(), plane(raw), there, plane(reference))[0], "raw_fix_error"
                )
        elif survey is None:
            survey = reference
    if survey is not None and (line := SurveyLine.through(plane(survey))) is not None:
        metrics |= _along(track, line, None if raw is None else plane(raw))
    return metrics | _losses(view, track, plane, reference)


def usable(table: pl.DataFrame | None) -> pl.DataFrame | None:
    """Return the rows that have a place, in the order of time, a time once; None where there are none."""
    if table is None or not {"lat_deg", "lon_deg"} <= set(table.columns):
        return None
    good = pl.col("lat_deg").is_finite() & pl.col("lon_deg").is_finite()
    if "status" in table.columns:
        good &= pl.col("status").fill_null(0) >= 0
    table = (
        table.filter(good).sort("t_ns", maintain_order=True).unique("t_ns", keep="last", maintain_order=True)
    )
    return None if table.is_empty() else table


def _raw_fixes(view: RunView) -> pl.DataFrame | None:
    topics = view.inputs.get("gnss", ())
    table = usable(view.raw(topics[0])) if topics else None
    for bound, inside in (("start_ns", pl.col("t_ns").ge), ("end_ns", pl.col("t_ns").lt)):
        if table is not None and (limit := view.lineage.get(f"range.{bound}")):
            table = table.filter(inside(int(limit)))
    return table


def stated_covariances(
    table: pl.DataFrame, state: pl.DataFrame | None, sd: tuple[str, str] = ("sd_east_m", "sd_north_m")
) -> FloatArray:
    """Return the covariances that a run states, shape (n, 2, 2)."""
    cov = np.full((table.height, 2, 2), np.nan)
    if not set(sd) <= set(table.columns):
        return cov
    east, north = (table[c].cast(pl.Float64).fill_null(np.nan).to_numpy() for c in sd)
    together = np.zeros(table.height)
    if state is not None and "correlation_en" in state.columns:
        state = state.unique("t_ns", keep="last", maintain_order=True)
        joined = table.select("t_ns").join(state.select("t_ns", "correlation_en"), on="t_ns", how="left")
        together = joined["correlation_en"].fill_null(0.0).to_numpy()
    cov[:, 0, 0], cov[:, 1, 1] = east**2, north**2
    cov[:, 0, 1] = cov[:, 1, 0] = np.clip(together, -0.9999, 0.9999) * east * north
    return cov


def squared(error: FloatArray, cov: FloatArray) -> FloatArray:
    """Return the normalized errors squared eᵀ P⁻¹ e of shape (n,); NaN where P is not positive definite."""
    out = np.full(len(error), np.nan)
    det = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2
    stated = np.isfinite(det) & (det > 0) & (cov[:, 0, 0] > 0)
    x, y = error[stated, 0], error[stated, 1]
    a, b, c = cov[stated, 0, 0], cov[stated, 0, 1], cov[stated, 1, 1]
    out[stated] = (c * x * x - 2 * b * x * y + a * y * y) / det[stated]
    return out


def _against(
    t_ns: IntArray, xy: FloatArray, there: IntArray, reference: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return errors at the times that the reference has, and which they are."""
    pairs = match(t_ns, there, REFERENCE_GAP_S)
    return xy[pairs.index] - pairs.linear(reference), pairs.index


def _errors(error: FloatArray, name: str) -> dict[str, float]:
    if not len(error):
        return {}
    size = np.hypot(*error.T)
    return {
        f"{name}_mean_m": float(size.mean()),
        f"{name}_median_m": float(np.median(size)),
        f"{name}_p75_m": float(np.percentile(size, 75)),
        f"{name}_p95_m": float(np.percentile(size, 95)),
        f"{name}_max_m": float(size.max()),
        f"{name}_end_m": float(size[-1]),
    }


def _beside(track: Places, there: IntArray, reference: FloatArray, name: str) -> dict[str, float]:
    error, index = _against(track.t_ns, track.xy, there, reference)
    return _errors(error, name) | _consistency(error, track.cov[index])


def _consistency(error: FloatArray, cov: FloatArray) -> dict[str, float]:
    """Return how the errors fit what is stated of them."""
    ratio = squared(error, cov)
    stated = np.isfinite(ratio)
    if not stated.any():
        return {}
    return {
        "ellipse95_percent": float(100.0 * np.mean(ratio[stated] <= ELLIPSE95)),
        "nees_horizontal": float(ratio[stated].mean()),
        "nees_horizontal_end": float(ratio[stated][-1]),
    }


def waypoint_ellipse(view: RunView) -> dict[str, float]:
    """Share of surveyed points inside the 95 % ellipse of a track that is laid on the first of them."""
    compared = view.compared("origin")
    if compared is None or compared.on_estimate or len(compared.t_ns) < 2:
        return {}
    cov = _local_covariances(view)
    if not len(cov) or (sigma := view.table("sigma")) is None:
        return {}
    newest = np.searchsorted(sigma["t_ns"].to_numpy(), compared.t_ns, "right") - 1
    later = newest[1:] >= 0  # the first one has no error by definition
    begin = cov[newest[0]] if newest[0] >= 0 else np.zeros((2, 2))
    grown = cov[np.maximum(newest[1:], 0)] - begin
    return _consistency(compared.error[1:, :2][later], grown[later])


def _local_covariances(view: RunView) -> FloatArray:
    """Return the covariances that a local track of a phone states; none of other estimators'."""
    if not view.has("state"):
        return np.empty((0, 2, 2))  # before the large table of standard deviations is read
    sigma, state = view.table("sigma"), view.table("state")
    if sigma is None or not {"sigma_pos_x", "sigma_pos_y"} <= set(sigma.columns):
        return np.empty((0, 2, 2))
    if state is None or "correlation_en" not in state.columns:
        return np.empty((0, 2, 2))
    return stated_covariances(sigma, state, ("sigma_pos_x", "sigma_pos_y"))


def _radius(cov: FloatArray) -> dict[str, float]:
    """Return how sure a run is of its places: the longer half axis of the 95 % ellipse."""
    cov = cov[np.isfinite(cov).all(axis=(1, 2))]
    if not len(cov):
        return {}
    axis = np.sqrt(ELLIPSE95 * np.maximum(np.linalg.eigvalsh(cov)[:, -1], 0.0))
    return {"accuracy95_median_m": float(np.median(axis)), "accuracy95_end_m": float(axis[-1])}


# -- survey -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SurveyLine:
    """A surveyed route: pieces that hang together but for where places lie far apart.

    Attributes
    ----------
    pieces : ndarray, shape (n, 2, 2)
        Begin and end of each (m).
    ends : ndarray, shape (k, 2)
        Where the route begins, ends or is interrupted.
    """

    pieces: FloatArray
    ends: FloatArray

    @classmethod
    def through(cls, xy: FloatArray) -> SurveyLine | None:
        """Return the line through places in the order in which they were surveyed; None where there is none.

        Shape of ``xy``: (n, 2), m.
        """
        xy = xy[np.concatenate(([True], np.hypot(*np.diff(xy, axis=0).T) > 0))]
        joined = np.hypot(*np.diff(xy, axis=0).T) <= LINE_GAP_M
        if not joined.any():
            return None
        before, after = np.concatenate(([False], joined[:-1])), np.concatenate((joined[1:], [False]))
        ends = np.vstack((xy[:-1][joined & ~before], xy[1:][joined & ~after]))
        pieces = np.stack((xy[:-1], xy[1:]), axis=1)[joined]
        count = np.ceil(np.hypot(*(pieces[:, 1] - pieces[:, 0]).T) / PIECE_M).astype(int)
        which = np.repeat(np.arange(len(pieces)), count)
        part = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count))[:, None]
        way = (pieces[which, 1] - pieces[which, 0]) / count[which, None]
        begin = pieces[which, 0] + part * way
        return cls(np.stack((begin, begin + way), axis=1), ends)

    @cached_property
    def _middles(self) -> KDTree:
        from scipy.spatial import KDTree

        return KDTree(self.pieces.mean(axis=1))

    def nearest(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the nearest places on the line, (n, 2), and whether the points lie beside it, (n,).

        A point whose nearest place is an end of the line lies beyond it, where nothing is known. Whoever
        surveys stands still at an end: places within :data:`END_M` of it are the end.
        """
        tree = self._middles
        begin, way = self.pieces[:, 0], self.pieces[:, 1] - self.pieces[:, 0]
        length = np.maximum((way**2).sum(axis=1), 1e-12)
        # The nearest piece lies no farther than the nearest middle, and its own middle half a piece beyond.
        reach = tree.query(points)[0] + 0.5 * math.sqrt(length.max()) + 1e-9
        out = np.empty_like(points)
        for k, near in enumerate(tree.query_ball_point(points, reach)):
            p, b, w = points[k], begin[near], way[near]
            part = np.clip(((p - b) * w).sum(axis=1) / length[near], 0.0, 1.0)
            on = b + part[:, None] * w
            out[k] = on[np.argmin(((on - p) ** 2).sum(axis=1))]
        at_end = (np.hypot(*(out[:, None] - self.ends).transpose(2, 0, 1)) < END_M).any(axis=1)
        return out, ~(at_end & (np.hypot(*(points - out).T) > END_M))


def by_shape(points: FloatArray, line: SurveyLine) -> FloatArray:
    """Return the points moved and turned, without scale, so that they lie on a line as well as they can.

    Shapes: ``points`` and result (n, 2), m.

    Nearest places and Horn's transform in turn (iterative closest point, Besl and McKay 1992), from where the
    points are. Points beyond the ends of the line move with the others and have no say.
    """
    moved = points
    for _ in range(SHAPE_ROUNDS):
        there, inside = line.nearest(moved)
        try:
            fitted = horn(moved[inside], there[inside], scale=False)
        except AlgorithmError:
            return points
        change = fitted.apply(moved) - moved
        moved = moved + change
        if np.abs(change).max() < 1e-3:
            break
    return moved


def _along(track: Places, line: SurveyLine, raw: FloatArray | None) -> dict[str, float]:
    """Return distances to a survey's line, without and with alignment by shape, and those of the raw fixes."""
    metrics = _off(track.xy, line, "line")
    metrics |= _off(by_shape(track.xy, line), line, "line_shape")
    if raw is not None:
        metrics |= _off(raw, line, "raw_line")
    there, inside = line.nearest(track.xy)
    metrics["line_covered_percent"] = float(100.0 * inside.mean())
    across = _across((track.xy - there)[inside], track.cov[inside])
    if len(across):
        metrics["line_within95_percent"] = float(100.0 * np.mean(across <= 1.959964))
    return metrics


def _off(points: FloatArray, line: SurveyLine, name: str) -> dict[str, float]:
    there, inside = line.nearest(points)
    away = np.hypot(*(points - there).T)
    metrics = {}
    for part, chosen in (("", away[inside]), ("_all", away)):
        if len(chosen):
            metrics[f"{name}{part}_median_m"] = float(np.median(chosen))
            metrics[f"{name}{part}_p95_m"] = float(np.percentile(chosen, 95))
    return metrics


def _across(off: FloatArray, cov: FloatArray) -> FloatArray:
    """Return distances to the line over the deviation that is stated across it."""
    away = np.hypot(*off.T)
    stated = (away > 1e-9) & np.isfinite(cov).all(axis=(1, 2))
    normal = off[stated] / away[stated, None]
    variance = np.einsum("ni,nij,nj->n", normal, cov[stated], normal)
    return away[stated][variance > 0] / np.sqrt(variance[variance > 0])


# -- loss of the signal -------------------------------------------------------------------------------------


def withheld(view: RunView) -> list[tuple[int, int]]:
    """Return from when to when (ns) the fixes of a run were withheld from it."""
    spans = json.loads(view.lineage.get("withheld", "{}"))
    topics = view.inputs.get("gnss", ())
    return [(int(a), int(b)) for topic, pairs in spans.items() if topic in topics for a, b in pairs]


def _losses(view: RunView, track: Places, plane: Plane, reference: pl.DataFrame | None) -> dict[str, float]:
    """Return errors at the ends of artificial losses: against the reference, else against what was withheld.

    The estimate is that of the last moment before a fix could help it.
    """
    raw = _raw_fixes(view)
    truth = reference if reference is not None else raw
    if truth is None or not (spans := withheld(view)):
        return {}
    there, xy = truth["t_ns"].to_numpy(), plane(truth)
    steps = view.table("step")
    size, ratio = [], []
    for start, end in spans:
        before = track.t_ns < end
        within = np.flatnonzero((there >= start) & (there < end))
        if not before.any() or not len(within) or there[within[-1]] < end - 1e9 * (REFERENCE_GAP_S + 10):
            continue
        last = int(there[within[-1]])
        before_loss = Places(track.t_ns[before], track.xy[before], track.cov[before])
        mine = _place_at(before_loss, steps, last)
        error = mine - xy[within[-1]]
        size.append(float(np.hypot(*error)))
        ratio.append(squared(error[None], before_loss.cov[-1:])[0])
    if not size:
        return {}
    metrics = {"loss_error_m": float(np.mean(size)), "loss_error_max_m": float(np.max(size))}
    if np.isfinite(ratio).any():
        metrics["loss_ellipse95_percent"] = float(100.0 * np.mean(np.array(ratio) <= ELLIPSE95))
    return metrics


def _place_at(track: Places, steps: pl.DataFrame | None, t_ns: int) -> FloatArray:
    """Return where a track that goes step by step was at a time; after its end where it ended."""
    table = pl.DataFrame({"t_ns": track.t_ns, "pos_x": track.xy[:, 0], "pos_y": track.xy[:, 1], "pos_z": 0.0})
    walk = track_of(table)
    assert walk is not None
    if steps is not None and steps.height:
        steps = steps.filter(pl.col("end_ns") <= int(track.t_ns[-1]))
        if steps.height:
            walk = stepwise(walk, steps, None, None)
    return np.array(
        [np.interp(t_ns - walk.t_ns[0], walk.t_ns - walk.t_ns[0], walk.position[:, i]) for i in range(2)]
    )
