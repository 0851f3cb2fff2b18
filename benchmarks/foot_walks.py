"""Every real foot recording, with the defaults only: the error, and what the run says of itself.

``python -m benchmarks.foot_walks`` prints the table of docs/estimators.md; ``--changed`` runs every change of
:mod:`.foot_changes` on every recording and prints what got worse without a remark. Recordings are those of the
data folder's ``foot/`` (named by ``MARCHA_DATA``, default ``../shared/data``).
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
from marcha.algorithms import make, output_columns
from marcha.algorithms.contract import FloatArray, Remark
from marcha.algorithms.foot.remarks import IMU_COLUMNS
from marcha.ingest import convert
from marcha.replay.alignment import align

from .foot_changes import CHANGES, Walk

LENGTH_M = 22.1
CLIMB_M = 5.4
"""Of the stairs, upwards."""


@dataclass(frozen=True)
class Score:
    """What an estimate was worth.

    Attributes
    ----------
    error_m : float
        After rigid alignment, root mean square; of a walk without a reference, start to end; NaN without a truth.
    way_m, height_m : float
        Horizontal length of the track, height of its end over its start.
    steps : int
    remarks : list of Remark
    squared : float
        Squared error of the end, in its own sigmas, heading laid on the first three metres; NaN without a reference.
    track : ndarray, shape (n, 4)
        Seconds and positions.
    longer : float
        Way from stance to stance over the reference's at the same instants (footprints: from print to print), less
        one; NaN without a reference. The way of all samples would compare the reference's noise.
    """

    error_m: float
    way_m: float
    height_m: float
    steps: int
    remarks: list[Remark]
    squared: float = np.nan
    track: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    longer: float = np.nan

    @property
    def fatal(self) -> bool:
        """The results must not be used."""
        return any(r.fatal for r in self.remarks)


def walks(folder: Path, scratch: Path) -> Iterator[Walk]:
    """Yield every sensor of every recording below ``folder``; converted ones are kept in ``scratch``."""
    for path in sorted(p for p in folder.rglob("*") if p.suffix in (".csv", ".mat")):
        if "_strideIndex_" in path.name:
            continue
        target = scratch / f"{path.stem}.mcap"
        if not target.exists():
            convert(path, target)
        rec = mr.open(target)
        reference = next((t for t in rec.channels if t in ("/reference/pose", "/reference/footprints")), None)
        truth = rec.table(reference) if reference else None
        for topic, channel in rec.channels.items():
            if channel.schema != "sensor_msgs/msg/Imu":
                continue
            table = rec.table(topic)
            values = table.select(IMU_COLUMNS).to_numpy()
            yield Walk(
                f"{path.stem} {topic.rpartition('/')[2]}",
                table["t_ns"].to_numpy() * 1e-9,
                values[:, :3],
                values[:, 3:],
                truth["t_ns"].to_numpy() * 1e-9 if truth is not None else np.empty(0),
                truth.select("pos_x", "pos_y", "pos_z").to_numpy() if truth is not None else np.empty((0, 3)),
                flat=reference == "/reference/footprints",
                closed=path.stem.startswith("conf-") or path.stem == "short_walk",
                climb=CLIMB_M if path.stem.startswith("spiralStairs") else np.nan,
            )


def estimate(walk: Walk, name: str, **params: Any) -> Score:
    """Run an estimator over a walk and score it."""
    made: Any = make(name, rate_hz=walk.rate_hz, **params)
    rows = np.column_stack([np.diff(walk.t, prepend=walk.t[0]), walk.acc, walk.gyr])
    names = output_columns(made)
    if made.offline:
        out = made.process(rows)
    else:
        out = np.empty((len(rows), len(names)))
        made.run_block(np.ascontiguousarray(rows), out)
        out = np.vstack([out[made.latency :], made.flush()])
    index = {n: i for i, n in enumerate(names)}
    position = out[:, [index[f"pose.pos_{a}"] for a in "xyz"]]
    is_navigated = np.isfinite(position[:, 0])
    remarks = made.remarks()
    if not is_navigated.any():
        return Score(np.nan, 0.0, np.nan, 0, remarks)
    p, t = position[is_navigated], walk.t[is_navigated]
    sigma = (
        out[-1, [index[f"sigma.sigma_pos_{a}"] for a in "xyz"]]
        if "sigma.sigma_pos_x" in index
        else np.full(3, np.nan)
    )
    steps = int(np.isfinite(out[:, index["step.index"]]).sum())
    way = float(np.hypot(*np.diff(p[:, :2], axis=0).T).sum())
    error, squared = _error(walk, t, p), _squared(walk, t, p, sigma)
    track, still = np.column_stack([t, p]), out[is_navigated, index["stance.still"]] > 0.5
    longer = _longer(walk, t, p, still)
    return Score(error, way, float(p[-1, 2] - p[0, 2]), steps, remarks, squared, track, longer)


def _matched(walk: Walk, t: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inside = (walk.truth_t >= t[0]) & (walk.truth_t <= t[-1])
    times = walk.truth_t[inside]
    return np.column_stack([np.interp(times, t, c) for c in p.T]), walk.truth[inside]


def _error(walk: Walk, t: np.ndarray, p: np.ndarray) -> float:
    mine, true = _matched(walk, t, p)
    if len(true) > 2:
        if walk.flat:
            mine, true = mine * [1, 1, 0], true * [1, 1, 0]
        gap = align(mine, true, "se2" if walk.flat else "se3").points(mine) - true
        return float(np.sqrt((gap**2).sum(axis=1).mean()))
    if walk.closed:
        return float(np.hypot(*(p[-1] - p[0])[:2]))
    return abs(float(p[-1, 2] - p[0, 2]) - walk.climb)


def _longer(walk: Walk, t: np.ndarray, p: np.ndarray, still: np.ndarray) -> float:
    if walk.flat:
        mine, true = _matched(walk, t, p)
    else:
        edges = np.diff(still.astype(int), prepend=0, append=0)
        first, end = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        middle = ((first + end) // 2)[end - first >= 4]
        low, high = walk.truth_t.min(initial=np.inf), walk.truth_t.max(initial=-np.inf)
        middle = middle[(t[middle] >= low) & (t[middle] <= high)]
        if not middle.size:
            return np.nan
        mine = p[middle]
        true = np.column_stack([np.interp(t[middle], walk.truth_t, c) for c in walk.truth.T])
    ways = [np.hypot(*np.diff(x[:, :2], axis=0).T) for x in (mine, true)]
    is_stride = ways[1] > 0.3
    return float(ways[0][is_stride].sum() / ways[1][is_stride].sum() - 1.0) if is_stride.any() else np.nan


def _squared(walk: Walk, t: np.ndarray, p: np.ndarray, sigma: np.ndarray) -> float:
    mine, true = _matched(walk, t, p)
    if len(true) < 100 or walk.flat:
        return np.nan
    a, b = mine - mine[0], true - true[0]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(b[:, :2], axis=0).T))])
    m = a[way < 3.0][:, :2].T @ b[way < 3.0][:, :2]
    yaw = np.arctan2(m[0, 1] - m[1, 0], m[0, 0] + m[1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return float((((a[-1] - back @ b[-1]) / sigma) ** 2).sum())


def _row(walk: Walk, score: Score) -> str:
    kinds = ", ".join(f"**{r.kind}**" if r.fatal else r.kind for r in score.remarks)
    figures = f"{score.steps} | {score.way_m:.1f} | {score.height_m:+.2f} | {score.error_m:.3f}"
    return f"| {walk.name} | {figures} | {kinds} |"


def promise(walk: Walk, score: Score) -> str:
    """Return which promise a result breaks: off by a metre without a remark, or a walk that stood still."""
    if score.fatal:
        return ""
    if (
        not score.remarks
        and not score.error_m <= 1.0
        and (walk.truth.size or walk.closed or np.isfinite(walk.climb))
    ):
        return f"{score.error_m:.2f} m without a remark"
    if score.error_m < 0.01 and score.way_m < 1.0:
        return "stood still"
    return ""


def changed(walk: Walk, name: str) -> Iterator[tuple[str, Score, str]]:
    """Yield every change with its score and what is wrong with it: worse than the walk as it is, without a remark.

    A walk without a reference is compared with its own track, unchanged.
    """
    usual = estimate(walk, name)
    if not walk.truth.size and usual.track.size:
        walk = replace(walk, truth_t=usual.track[:, 0], truth=usual.track[:, 1:])
    for change, make_it in CHANGES.items():
        other = make_it(walk)
        score = estimate(other, name)
        new = {r.kind for r in score.remarks} - {r.kind for r in usual.remarks}
        wrong = promise(other, score)
        if (
            not wrong
            and not score.fatal
            and not new
            and score.error_m > max(2 * usual.error_m, usual.error_m + 0.15)
        ):
            wrong = f"{score.error_m:.2f} m instead of {usual.error_m:.2f} m"
        yield change, score, wrong


def main() -> int:
    """Run as a script."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--estimator", default="foot.9iez")
    parser.add_argument("--changed", action="store_true", help="every change of every recording")
    parser.add_argument("--only", default="", help="part of the recordings' names")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("MARCHA_DATA", "../shared/data")))
    parser.add_argument("--scratch", type=Path, help="keep the converted recordings here")
    options = parser.parse_args()
    if not (options.data / "foot").is_dir():
        parser.error(f"{options.data / 'foot'}: no such folder; name the data by --data or MARCHA_DATA")
    broken = 0
    longer: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as temporary:
        recordings = [
            w
            for w in walks(options.data / "foot", options.scratch or Path(temporary))
            if options.only in w.name
        ]
        print(
            "| recording | steps | way m | height m | error m | remarks (**fatal**) |\n|---|---|---|---|---|---|"
        )
        for walk in recordings:
            if not options.changed:
                score = estimate(walk, options.estimator)
                longer[walk.name] = score.longer
                print(_row(walk, score), promise(walk, score), flush=True)
                broken += bool(promise(walk, score))
                continue
            for change, score, wrong in changed(walk, options.estimator):
                print(_row(walk, score), change, "| WRONG: " + wrong if wrong else "", flush=True)
                broken += bool(wrong)
    print(f"{broken} promises broken")
    ratios = ", ".join(f"{name} {100 * value:+.1f}" for name, value in longer.items() if np.isfinite(value))
    print(f"% longer than the reference from stance to stance: {ratios}" if ratios else "no reference")
    return int(bool(broken))


if __name__ == "__main__":
    raise SystemExit(main())
