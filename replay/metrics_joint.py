"""Figures of merit of joint angles, beside a reference: of all samples and per gait cycle.

Names end in the joint's: ``rmse_deg.knee``. Error = estimate − reference, in degrees, wrapped to ±180°. Estimates are
interpolated at the reference's times, never across more than 0.1 s; delay is estimated and stated, not removed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from ..algorithms.contract import FloatArray
from .alignment import IntArray
from .references import reference_of
from .trajectory import inside

if TYPE_CHECKING:
    from .view import RunView

SETTLING_S = 1.2
"""Start of a run that is left out, as in the source."""
GAP_NS = 100_000_000
POINTS = 101
JOINT_STATE = "sensor_msgs/msg/JointState"
LEAST_EVENTS = 3
"""Fewer events of one leg are no cycles."""
_EVENT = re.compile(r"(heelstrike|heelcontact|footstrike|footcontact|initialcontact|hs|ic|cyclestart)")
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
ATTITUDE_FIGURES = (
    "rmse_deg",
    "rmse_unbiased_deg",
    "bias_deg",
    "pearson_r",
    "delay_s",
    "within95_percent",
    "nees",
)
_FOREIGN = re.compile(
    r"(?P<before>left_|right_|[LlRr]_?)?(?P<joint>[Hh]ip|[Kk]nee|[Aa]nkle)(_?[Aa]ngles?|_flexion)?(?P<after>_left|_right|_[lr])?"
)


def wrapped_deg(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Return estimate − reference (rad) in degrees within ±180.

    Shapes: all (n,).
    """
    return np.degrees((estimate - reference + np.pi) % (2.0 * np.pi) - np.pi)


def rmse_deg(error_deg: FloatArray) -> float:
    """Return the root mean square error.

    Shape of ``error_deg``: (n,).
    """
    return float(np.sqrt(np.mean(np.square(error_deg)))) if error_deg.size else float("nan")


def bias_deg(error_deg: FloatArray) -> float:
    """Return the mean error.

    Shape of ``error_deg``: (n,).
    """
    return float(np.mean(error_deg)) if error_deg.size else float("nan")


def rmse_unbiased_deg(error_deg: FloatArray) -> float:
    """Return the root mean square error about the mean error.

    Shape of ``error_deg``: (n,).
    """
    return float(np.std(error_deg)) if error_deg.size else float("nan")


def pearson_r(a: FloatArray, b: FloatArray) -> float:
    """Return Pearson's correlation; NaN where one does not vary.

    Shapes: both (n,).
    """
    if a.size < 2 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def rom_error_deg(estimate: FloatArray, reference: FloatArray) -> float:
    """Return the error of the range of motion, largest minus smallest angle (rad in, degrees out).

    Shapes: both (n,).
    """
    return float(np.degrees(np.ptp(estimate) - np.ptp(reference))) if estimate.size else float("nan")


def bland_altman_deg(error_deg: FloatArray) -> tuple[float, float]:
    """Return the limits of agreement: mean ∓ 1.96 standard deviations (Bland and Altman 1986).

    Shape of ``error_deg``: (n,).
    """
    if error_deg.size < 2:
        return float("nan"), float("nan")
    spread = 1.96 * float(np.std(error_deg, ddof=1))
    return bias_deg(error_deg) - spread, bias_deg(error_deg) + spread


def delay_s(
    t_ns: IntArray, estimate: FloatArray, ref_ns: IntArray, reference: FloatArray, most_s: float = 0.3
) -> float:
    """Return by how much the estimate lags the reference: where the error without its mean is least.

    Shapes: the estimate's (n,), the reference's (m,); rad.

    Whole milliseconds between ± ``most_s``, refined by a parabola. NaN where the reference does not vary.
    """
    if len(t_ns) < 10 or len(ref_ns) < 10 or np.ptp(reference) < 1e-3:
        return float("nan")
    t0 = int(ref_ns[0])
    t, r = (t_ns - t0) * 1e-9, (ref_ns - t0) * 1e-9
    keep = (r > t[0] + most_s) & (r < t[-1] - most_s)
    if keep.sum() < 10:
        return float("nan")
    r, angle = r[keep], reference[keep]

    def spread(shift: float) -> float:
        return float(np.std(np.interp(r + shift, t, estimate) - angle))

    coarse = np.arange(-most_s, most_s + 1e-9, 0.01)
    near = coarse[int(np.argmin([spread(s) for s in coarse]))]
    fine = near + np.arange(-0.01, 0.0101, 0.001)
    cost = np.array([spread(s) for s in fine]) ** 2
    k = int(np.argmin(cost))
    if 0 < k < len(fine) - 1:
        bend = cost[k - 1] - 2.0 * cost[k] + cost[k + 1]
        return float(fine[k] + (0.0005 * (cost[k - 1] - cost[k + 1]) / bend if bend > 0.0 else 0.0))
    return float(fine[k])


def consistency(error_deg: FloatArray, sigma_deg: FloatArray) -> dict[str, float]:
    """Return the share of errors inside the stated 95 % and the mean squared error over its stated variance.

    Shapes: both (n,).

    Errors count with their mean: a mounting that is off, a reference's own error and delay are in them.
    """
    stated = np.isfinite(sigma_deg) & (sigma_deg > 0.0)
    if not stated.any():
        return {}
    ratio = np.square(error_deg[stated] / sigma_deg[stated])
    return {
        "within95_percent": float(100.0 * np.mean(ratio <= 1.959964**2)),
        "nees": float(np.mean(ratio)),
    }


def cmc(curves: FloatArray) -> float:
    """Return the coefficient of multiple correlation within a day (Kadaba et al. 1989, eq 1).

    Parameters
    ----------
    curves : ndarray, shape (cycles, points)
        Curves to be compared: cycles of one joint, or estimate and reference of one cycle.
    """
    m, n = curves.shape
    if m < 2:
        return float("nan")
    within = float(np.sum((curves - curves.mean(axis=0)) ** 2)) / (n * (m - 1))
    total = float(np.sum((curves - curves.mean()) ** 2)) / (m * n - 1)
    return float(np.sqrt(max(0.0, 1.0 - within / total))) if total > 0.0 else float("nan")


def cycles_of(
    t_ns: IntArray, angle: FloatArray, starts_ns: Sequence[int] | IntArray, most_s: float = 4.0
) -> FloatArray:
    """Return the angle of every cycle at 0, 1 … 100 %, shape (cycles, 101); NaN across gaps.

    A cycle lies between two neighbouring starts; longer ones than ``most_s`` are pauses and left out.
    """
    starts = np.asarray(starts_ns, np.int64)
    curves: list[FloatArray] = []
    for a, b in pairwise(starts.tolist()):
        if b - a > most_s * 1e9 or a < t_ns[0] or b > t_ns[-1]:
            continue
        grid = a + np.linspace(0.0, float(b - a), POINTS)
        k = np.clip(np.searchsorted(t_ns, grid), 1, len(t_ns) - 1)
        curve = np.interp(grid - a, (t_ns - a).astype(np.float64), angle)
        curve[(t_ns[k] - t_ns[k - 1]) > GAP_NS] = np.nan
        curves.append(curve)
    return np.array(curves) if curves else np.empty((0, POINTS))


def starts_from_signal(t_ns: IntArray, angle: FloatArray, least_s: float = 0.6) -> IntArray:
    """Return starts of cycles from a joint angle itself: its main maxima, at least ``least_s`` apart.

    Shapes: ``t_ns`` and ``angle`` (rad) (n,), result (cycles,) in ns.

    A maximum must reach half of the way from the median to the 99th percentile.
    """
    if len(angle) < 3:
        return np.empty(0, np.int64)
    from scipy.signal import find_peaks

    step = float(np.median(np.diff(t_ns))) * 1e-9
    middle, top = float(np.median(angle)), float(np.percentile(angle, 99))
    peaks, _ = find_peaks(angle, height=middle + 0.5 * (top - middle), distance=max(1, int(least_s / step)))
    return t_ns[peaks]


def events_of(annotations: pl.DataFrame, joint: str) -> IntArray:
    """Return the times of annotated foot contacts that belong to a joint's leg, (n,) ns; empty without.

    A joint without a side takes events without a side, else those of the only side there is.
    """
    starts: dict[str, list[int]] = {}
    for start, label in annotations.select("start_ns", "label").iter_rows() if annotations.height else ():
        words = [w for w in re.split(r"[^a-z]+", (label or "").lower()) if w]
        side = next((_SIDES[w] for w in words if w in _SIDES), "")
        if _EVENT.fullmatch("".join(w for w in words if w not in _SIDES)):
            starts.setdefault(side, []).append(start)
    wanted = next((side for side in ("left", "right") if joint.startswith(f"{side}_")), "")
    chosen = starts.get(wanted, [])
    if not chosen and not wanted and len(starts) == 1:
        chosen = next(iter(starts.values()))
    return np.unique(np.array(chosen, np.int64))


def matched(
    t_ns: IntArray, angle: FloatArray, ref_ns: IntArray, reference: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return reference times with a value of both, estimate and reference there, after settling.

    Shapes: the estimate's (n,), the reference's (m,), results (k,); rad.
    """
    good, ok = np.isfinite(angle), np.isfinite(reference)
    t, angle, r, reference = t_ns[good], angle[good], ref_ns[ok], reference[ok]
    if len(t) < 2 or len(r) == 0:
        return r[:0], angle[:0], reference[:0]
    k = np.clip(np.searchsorted(t, r), 1, len(t) - 1)
    inside = (r >= t[0] + int(SETTLING_S * 1e9)) & (r <= t[-1]) & (t[k] - t[k - 1] <= GAP_NS)
    r, reference = r[inside], reference[inside]
    value = np.interp((r - t[0]).astype(np.float64), (t - t[0]).astype(np.float64), np.unwrap(angle))
    return r, value, reference


def figures(
    t_ns: IntArray,
    angle: FloatArray,
    ref_ns: IntArray,
    reference: FloatArray,
    starts_ns: IntArray | None = None,
    spans: IntArray | None = None,
    stated: tuple[IntArray, FloatArray] | None = None,
) -> dict[str, float]:
    """Return all figures of one joint, names without the joint's; of stretches of time where they are given.

    Shapes: the estimate's (n,), the reference's (m,), ``spans`` (k, 2) in ns.

    Cycles are those of the whole walk that lie in a stretch whole; ``starts_ns`` of cycles count instead of the
    signal's. ``stated`` are the standard deviations that the estimate states (ns, rad).
    """
    times, value, truth = matched(t_ns, angle, ref_ns, reference)
    starts = starts_from_signal(times, truth) if starts_ns is None else starts_ns
    parts = [starts] if spans is None else [starts[inside(starts, s[None])] for s in spans]
    curves = [(cycles_of(times, value, p), cycles_of(times, truth, p)) for p in parts if times.size]
    if spans is not None:
        keep = inside(times, spans)
        times, value, truth = times[keep], value[keep], truth[keep]
    if times.size == 0:
        return {}
    error = wrapped_deg(value, truth)
    low, high = bland_altman_deg(error)
    good = np.isfinite(angle)
    metrics = {
        "samples": float(times.size),
        "rmse_deg": rmse_deg(error),
        "rmse_unbiased_deg": rmse_unbiased_deg(error),
        "bias_deg": bias_deg(error),
        "pearson_r": pearson_r(value, truth),
        "rom_error_deg": rom_error_deg(value, truth),
        "delay_s": delay_s(t_ns[good], np.unwrap(angle[good]), times, truth),
        "agreement_low_deg": low,
        "agreement_high_deg": high,
    }
    if stated is not None:
        metrics.update(
            consistency(error, np.degrees(np.interp(times - t_ns[0], stated[0] - t_ns[0], stated[1])))
        )
    ours, theirs = (np.concatenate(c) for c in zip(*curves, strict=True))
    whole = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    if whole.sum() >= 2:
        ours, theirs = ours[whole], theirs[whole]
        each = wrapped_deg(ours, theirs)
        metrics["cycles"] = float(len(ours))
        metrics["cycle_rmse_deg"] = float(np.mean(np.sqrt(np.mean(each**2, axis=1))))
        metrics["cycle_rom_error_deg"] = float(
            np.degrees(np.mean(np.ptp(ours, axis=1) - np.ptp(theirs, axis=1)))
        )
        metrics["cmc"] = float(np.mean([cmc(np.stack(pair)) for pair in zip(ours, theirs, strict=True)]))
    return metrics


def joints(view: RunView) -> dict[str, float]:
    """Errors of joint angles: RMSE, bias, correlation, range of motion, delay, limits of agreement, cycles; and the
    share inside the stated 95 %.
    """
    base = view.whole or view
    metrics: dict[str, float] = {}
    if not (pairs := list(_pairs(base))):
        return metrics  # a long walk's table is not read for nothing
    sigma = base.table("sigma")
    for name, own, truth, sign in pairs:
        events = events_of(base.annotations, name)
        starts = events if len(events) >= LEAST_EVENTS else None
        values = figures(own[0], own[1], truth[0], sign * truth[1], starts, view.spans, _stated(sigma, name))
        metrics.update({f"{key}.{name}": value for key, value in values.items()})
    return metrics


def attitudes(view: RunView) -> dict[str, float]:
    """Errors of segments' roll and pitch against the reference's orientation (``rmse_deg.thigh_roll``)."""
    base = view.whole or view
    ours = base.table("attitude")
    if ours is None:
        return {}
    metrics: dict[str, float] = {}
    sigma = base.table("sigma")
    tables = base.reference_tables("orientation")
    for topic in sorted(tables, key=len, reverse=True):  # a source's own goes before those made of markers
        table = tables[topic]
        segment = topic.split("/")[-2]
        wanted = [a for a in ("roll", "pitch") if f"{segment}_{a}" in ours.columns]
        if not wanted or table.is_empty():
            continue
        w, x, y, z = (table[f"quat_{a}"].to_numpy() for a in "wxyz")
        up = np.stack(
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
        )  # of n, in the segment
        if float(np.nanmedian(up[2])) < 0.5:
            continue  # the capture's z is not up: its orientation says nothing of gravity
        truth = {"roll": np.arctan2(up[1], up[2]), "pitch": np.arctan2(-up[0], np.hypot(up[1], up[2]))}
        for angle in wanted:
            name = f"{segment}_{angle}"
            values = figures(
                *_column(ours, name),
                table["t_ns"].to_numpy(),
                truth[angle],
                spans=view.spans,
                stated=_stated(sigma, name),
            )
            metrics.update({f"{key}.{name}": v for key, v in values.items() if key in ATTITUDE_FIGURES})
    return metrics


def angles_beside(view: RunView) -> list[tuple[str, IntArray, FloatArray, FloatArray]]:
    """Return joint, times, estimate and reference (rad) at them, of every joint that has a reference."""
    result = []
    for name, own, truth, sign in _pairs(view):
        t_ns, estimate, reference = matched(*own, truth[0], sign * truth[1])
        if t_ns.size:
            result.append((name, t_ns, estimate, reference))
    return result


def doubts(view: RunView) -> list[str]:
    """Return what is odd between a run's joints and its reference: none of its name, or one that turns against it."""
    ours, truth = view.table("joint"), view.reference_table("joint")
    if ours is None or truth is None:
        return []
    result = []
    for name in joint_columns(ours):
        if reference_column(name, joint_columns(truth)) is None:
            there = ", ".join(
                c for c in joint_columns(truth) if _side_and_joint(c)[1] == _side_and_joint(name)[1]
            )
            if there:
                result.append(
                    f"{name}: the reference has {there}; convert it with --set side=left (or right)"
                )
    beside = angles_beside(view)
    result += _clocks(view)
    result += _coverage(ours, truth, sum(t_ns.size for _, t_ns, _, _ in beside))
    for name, t_ns, estimate, reference in beside:
        if t_ns.size > 100 and pearson_r(estimate, reference) < -0.5:
            result.append(
                f"{name}: turns against its reference (r {pearson_r(estimate, reference):.2f}): reverse the sign of "
                "axis (-p axis=-x instead of x), or check which sensor is on which segment"
            )
    return result


def _clocks(view: RunView) -> list[str]:
    """Say where the joints' reference runs on another clock than the run's sensors."""
    if view.recording is None:
        return []
    clocks = view.recording.metadata.get("clocks", {})
    topic = view.lineage.get("input", "")
    reference = reference_of(
        view.recording.channels, "joint", topic, view.chosen_reference, str(view.recording.path)
    )
    own, other = clocks.get(topic, ""), clocks.get(reference or "", "")
    if not own or not other or own == other:
        return []
    return [
        f"the reference's clock ({other}) is not that of the sensors ({own}): errors "
        "hold only where both began together; align them first (marcha align)"
    ]


def _coverage(ours: pl.DataFrame, truth: pl.DataFrame, compared: int) -> list[str]:
    """Say where estimate and reference have no time in common, or the reference covers a part only."""
    if ours.is_empty() or truth.is_empty():
        return []
    first, last, start, end = (
        float(f(t["t_ns"].to_numpy())) * 1e-9 for t in (ours, truth) for f in (np.min, np.max)
    )
    if start > last or end < first:
        return [
            f"no overlap: the estimate covers {first:.1f} to {last:.1f} s, the reference {start:.1f} to {end:.1f} s; "
            "bring them on one clock with marcha align"
        ]
    common = min(last, end) - max(first, start)
    if compared and common < 0.9 * (last - first):
        return [
            f"the reference covers {common:.1f} s of the estimate's {last - first:.1f} s: only these are judged"
        ]
    return []


Series = tuple[IntArray, FloatArray]


def _pairs(view: RunView) -> list[tuple[str, Series, Series, float]]:
    ours, truth = view.table("joint"), view.reference_table("joint")
    if ours is None or truth is None:
        return []
    pairs = []
    for name in joint_columns(ours):
        column = reference_column(name, joint_columns(truth))
        if column is not None:
            pairs.append((name, _column(ours, name), _column(truth, column[0]), column[1]))
    return pairs


def reference_column(joint: str, columns: Sequence[str]) -> tuple[str, float] | None:
    """Return the column of a reference that speaks of a joint, and its sign against ours; None without one.

    The same name counts before others' names of the same joint (Vicon's ``LKneeAngles``, OpenSim's ``hip_flexion_r``,
    whose hip flexion and dorsiflexion are positive). Of several legs none is taken for a joint without a side.
    """
    if joint in columns:
        return joint, 1.0
    side, plain = _side_and_joint(joint)
    fitting = []
    for column in columns:
        its_side, its = _side_and_joint(column)
        if its == plain and (not side or not its_side or its_side == side):
            foreign = column != its and not column.startswith(("left_", "right_"))
            fitting.append((column, -1.0 if foreign and plain in ("hip", "ankle") else 1.0))
    return fitting[0] if len(fitting) == 1 else None


def _side_and_joint(name: str) -> tuple[str, str]:
    """Return side (or empty) and joint of a name as ours, Vicon and OpenSim write it; others as they are."""
    match = _FOREIGN.fullmatch(name)
    if match is None:
        return "", name
    word = (match["before"] or match["after"] or "").lower().strip("_")[:1]
    return {"l": "left", "r": "right"}.get(word, ""), match["joint"].lower()


def joint_columns(table: pl.DataFrame) -> list[str]:
    """Return the columns that are angles of joints."""
    return [c for c in table.columns if c not in ("t_ns", "t_log_ns") and not c.endswith((".vel", ".effort"))]


def _stated(sigma: pl.DataFrame | None, name: str) -> Series | None:
    """Return times and stated standard deviations of an angle; None where a run states none."""
    return None if sigma is None or sigma.is_empty() or name not in sigma.columns else _column(sigma, name)


def _column(table: pl.DataFrame, name: str) -> tuple[IntArray, FloatArray]:
    t = table["t_ns"].to_numpy()
    value = table[name].cast(pl.Float64).to_numpy()
    keep = np.r_[True, np.diff(np.maximum.accumulate(t)) > 0]
    return t[keep], value[keep]
