"""``tune``: the thresholds that fit walks of known length best, by replaying them with many."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import polars as pl

from ..algorithms import (
    AlgorithmError,
    describe,
    find,
    make,
)
from ..recording import Recording
from ..recording.errors import UsageError
from .api import replay as replay_recording
from .engine import Progress
from .evaluate import recording_view, truth_of
from .metrics import closure, distance
from .results import Run
from .specs import EstimatorSpec, parse_estimator, parse_value
from .view import Truth

MOST_POINTS = 4096
"""A grid of more points is refused: coordinates one after another, or fewer values."""
BATCH = 16
"""Points that are replayed in one pass: bounds memory."""
ROUNDS = 6
"""Most passes over all coordinates."""
PLATEAU = 0.1
"""Points within so much of the best objective are called as good."""

Values = Sequence[Any]


@dataclass(frozen=True)
class Tuned:
    """What a search found.

    Attributes
    ----------
    estimator : str
        Name.
    params : dict
        The best point, together with the parameters that were held: ready for ``replay(…, params=…)`` or
        ``make``.
    objective : float
        Its objective, percent (see :func:`tune`).
    default_objective : float
        The same without any searched parameter; infinity where that run is of no use.
    table : polars.DataFrame
        One row a point in the order tried: the searched parameters, ``objective``, ``closure_percent``,
        ``distance_error_percent``, ``steps`` (means over all runs), ``runs`` and ``failed``.
    plateau : dict of str to tuple
        By parameter, all its values for which some point is as good as the best (within 10 % of it).
    warnings : tuple of str
        Why not to trust it too far: one walk, an end of a range, hardly better than the defaults.
    """

    estimator: str
    params: dict[str, Any]
    objective: float
    default_objective: float
    table: pl.DataFrame
    plateau: dict[str, tuple[Any, ...]]
    warnings: tuple[str, ...]


def parse_values(text: str, points: int = 7) -> tuple[Any, ...]:
    """Return the values that ``LOW:HIGH``, ``LOW:HIGH:COUNT`` or ``A,B,C`` stand for.

    A range is divided evenly, or by equal factors where it spans a factor of ten or more.

    Raises
    ------
    UsageError
        Where the text has another form.
    """
    if ":" not in text:
        return tuple(parse_value(part.strip()) for part in text.split(",") if part.strip())
    parts = text.split(":")
    try:
        low, high = float(parts[0]), float(parts[1])
        count = int(parts[2]) if len(parts) == 3 else points
    except ValueError:
        low, high, count = math.nan, math.nan, 0
    if len(parts) > 3 or count < 2 or not (low < high and math.isfinite(low) and math.isfinite(high)):
        raise UsageError(f"{text!r} is no range; expected LOW:HIGH, LOW:HIGH:COUNT (at least 2) or A,B,C")
    spaced = np.geomspace if low > 0 and high >= 10 * low else np.linspace
    return tuple(float(f"{x:.6g}") for x in spaced(low, high, count))


def tune(
    recordings: Recording | Sequence[Recording],
    estimator: str,
    search: Mapping[str, str | Values],
    *,
    method: Literal["grid", "coordinate"] = "grid",
    points: int = 7,
    inputs: Sequence[str] | None = None,
    length_m: float | None = None,
    closed: bool | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Search the parameters of an estimator that fit walks of known length best.

    The objective is the mean over all runs of ``closure_percent`` (where the walk is closed) +
    ``distance_error_percent`` (stance to stance); a run that must not be used makes its point infinite.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Walks; each says its ``length_m`` and ``closed`` in the metadata record ``truth``.
    estimator : str
        ``NAME`` or ``NAME[key=value,…]``; parameters in brackets are held.
    search : mapping
        Parameter to its values, or to the text of :func:`parse_values`.
    method : {"grid", "coordinate"}
        Every combination; or one parameter after the other, the others held at their best, until nothing
        improves: far fewer points, but it may end beside the best.
    points : int
        Values of a range that names no count.
    inputs : sequence of str, optional
        Topics, as in :func:`marcha.replay.replay`; every fitting one without it, and all count alike.
    length_m, closed : float, bool, optional
        What is known of every walk, in place of the recordings' own truth.
    progress : callable, optional
        Called with points done and points in all (0 where not known).

    Raises
    ------
    UsageError
        Unknown estimator or parameter, no length known, a grid too large, no point that works.
    """
    walks = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not walks:
        raise UsageError("tune: no recording given")
    spec = parse_estimator(estimator)
    values = {k: parse_values(v, points) if isinstance(v, str) else tuple(v) for k, v in search.items()}
    _check(spec, values)
    truths = [_truth(rec, length_m, closed) for rec in walks]
    objective = _Objective(spec, tuple(values), walks, truths, inputs, progress)
    if method == "grid":
        size = math.prod(len(v) for v in values.values())
        if size > MOST_POINTS:
            raise UsageError(
                f"tune: {size} points are too many (at most {MOST_POINTS}); give fewer values, or "
                "method coordinate"
            )
        objective.all = size + 1
        objective([None, *itertools.product(*values.values())])
    else:
        _coordinates(objective, values)
    return _result(objective, spec, values, truths)


def _check(spec: EstimatorSpec, values: Mapping[str, Values]) -> None:
    """Refuse a search that cannot work before anything is replayed."""
    try:
        parameters = {p.name: p for p in describe(find(spec.name).Params)}
        make(spec.name, **spec.params)
    except AlgorithmError as error:
        raise UsageError(str(error)) from None
    if not values:
        raise UsageError("tune: no parameter to search; give at least one, for example c3_max=0.3:1.0")
    for name, choices in values.items():
        if name not in parameters:
            raise UsageError(
                f"{spec.name} has no parameter {name!r}; it has: {', '.join(sorted(parameters))}"
            )
        if name in spec.params:
            raise UsageError(f"tune: {name} is both held (in the brackets) and searched; give it once")
        if not choices or len(set(choices)) != len(choices):
            raise UsageError(f"tune: {name} needs values, each once, not {list(choices)}")


def _truth(rec: Recording, length_m: float | None, closed: bool | None) -> Truth:
    own = truth_of(rec.metadata)
    truth = Truth(own.closed if closed is None else closed, own.length_m if length_m is None else length_m)
    if not truth.length_m or not truth.length_m > 0:
        raise UsageError(
            f"{rec.path}: the walk's length is not known; give length_m, or convert with --truth length_m=22.1"
        )
    return truth


class _Objective:
    """Replays points that were not tried yet, many in one pass, and keeps what came of them."""

    def __init__(
        self,
        spec: EstimatorSpec,
        names: tuple[str, ...],
        walks: Sequence[Recording],
        truths: Sequence[Truth],
        inputs: Sequence[str] | None,
        progress: Progress | None,
    ) -> None:
        self.spec, self.names, self.walks, self.truths = spec, names, walks, truths
        self.inputs, self.progress = inputs, progress
        self.all = 0
        self.tried: dict[tuple[Any, ...] | None, dict[str, float]] = {}
        self.refusal = ""

    def __call__(self, points: Iterable[tuple[Any, ...] | None]) -> list[float]:
        """Return the objective of every point; None is the estimator without searched parameters."""
        points = list(points)
        new = [p for p in dict.fromkeys(points) if p not in self.tried]
        for start in range(0, len(new), BATCH):
            self._replay(new[start : start + BATCH])
            if self.progress is not None:
                self.progress(len(self.tried), self.all)
        return [self.tried[p]["objective"] for p in points]

    def params(self, point: tuple[Any, ...] | None) -> dict[str, Any]:
        """Return held and searched parameters."""
        return self.spec.params | dict(zip(self.names, point or (), strict=bool(point)))

    def _replay(self, points: Sequence[tuple[Any, ...] | None]) -> None:
        usable = []
        for point in points:
            try:
                make(self.spec.name, **self.params(point))
                usable.append(point)
            except AlgorithmError as error:  # a combination that makes no sense, such as c1_min above c1_max
                self.refusal = str(error)
                self.tried[point] = _mean([])
        if not usable:
            return
        figures: dict[tuple[Any, ...] | None, list[dict[str, float] | None]] = {p: [] for p in usable}
        specs = [EstimatorSpec(self.spec.name, self.params(p), f"p{i}") for i, p in enumerate(usable)]
        for rec, truth in zip(self.walks, self.truths, strict=True):
            runs = replay_recording(rec, specs, inputs=self.inputs, metrics=False).runs
            each = len(runs) // len(usable)  # one run an input, in the order of the estimators
            for i, point in enumerate(usable):
                figures[point] += [_figures(rec, run, truth) for run in runs[i * each : (i + 1) * each]]
        for point in usable:
            self.tried[point] = _mean(figures[point])


def _figures(rec: Recording, run: Run, truth: Truth) -> dict[str, float] | None:
    """Return what counts of one run; None where it must not be used."""
    if run.fatal:
        return None
    view = replace(recording_view(rec, run.lineage, run.tables), truth=truth)
    figures = closure(view) | distance(view)
    if "distance_error_percent" not in figures:
        return None
    kept = {k: figures[k] for k in ("closure_percent", "distance_error_percent", "steps") if k in figures}
    total = figures.get("closure_percent", 0.0) + figures["distance_error_percent"]
    return kept | {"objective": total}


def _mean(figures: Sequence[dict[str, float] | None]) -> dict[str, float]:
    used = [f for f in figures if f is not None]
    names = ("closure_percent", "distance_error_percent", "steps", "objective")
    mean = {n: float(np.mean([f[n] for f in used if n in f] or [math.nan])) for n in names}
    if len(used) < len(figures) or not used:
        mean["objective"] = math.inf
    return mean | {"runs": len(figures), "failed": len(figures) - len(used)}


def _coordinates(objective: _Objective, values: Mapping[str, Values]) -> None:
    """Improve one parameter after the other, from each one's middle value, until a round changes nothing."""
    point = tuple(v[len(v) // 2] for v in values.values())
    objective([None, point])
    for _ in range(ROUNDS):
        before = point
        for i, choices in enumerate(values.values()):
            line = [(*point[:i], v, *point[i + 1 :]) for v in choices]
            line.sort(key=lambda p: p != point)  # stays where another is only as good
            point = line[int(np.argmin(objective(line)))]
        if point == before:
            return


def _result(
    objective: _Objective, spec: EstimatorSpec, values: Mapping[str, Values], truths: Sequence[Truth]
) -> Tuned:
    tried = {p: f for p, f in objective.tried.items() if p is not None}
    least = min(f["objective"] for f in tried.values())
    if not math.isfinite(least):
        why = f" ({objective.refusal})" if objective.refusal else ""
        raise UsageError(f"tune: none of {len(tried)} points gives a usable run{why}; search elsewhere")
    equal = [p for p, f in tried.items() if f["objective"] <= (1 + 1e-9) * least]
    best = equal[len(equal) // 2]  # the middle of a plateau, not its edge
    default = objective.tried[None]["objective"]
    good = [p for p, f in tried.items() if f["objective"] <= (1 + PLATEAU) * least]
    plateau = {
        name: tuple(v for v in choices if any(p[i] == v for p in good))
        for i, (name, choices) in enumerate(values.items())
    }
    return Tuned(
        spec.name,
        objective.params(best),
        least,
        default,
        pl.DataFrame([dict(zip(values, p, strict=True)) | f for p, f in tried.items()], strict=False),
        plateau,
        tuple(_warnings(values, best, plateau, least, default, truths)),
    )


def _warnings(
    values: Mapping[str, Values],
    best: tuple[Any, ...],
    plateau: Mapping[str, Values],
    least: float,
    default: float,
    truths: Sequence[Truth],
) -> Iterable[str]:
    if len(truths) == 1:
        yield (
            "tuned on one walk: the thresholds may fit its accidents (overfitting); check them on walks that "
            "were not used, or tune on several together"
        )
    elif len(truths) < 5:
        yield f"tuned on {len(truths)} walks only: check the thresholds on walks that were not used"
    if not all(t.closed for t in truths):
        yield "not every walk is known to be closed: there only the distance counts, not the direction"
    for name, value in zip(values, best, strict=True):
        numbers = [v for v in values[name] if isinstance(v, int | float) and not isinstance(v, bool)]
        if len(numbers) < 2 or isinstance(value, bool | str):
            continue
        if len(plateau[name]) == len(values[name]):
            yield f"{name}: every value is within {PLATEAU:.0%} of the best: the walks do not tell it"
        elif value in (min(numbers), max(numbers)):
            yield f"{name}={value:g} is the end of its range: the best may lie beyond"
    if default <= (1 + PLATEAU) * least:
        yield (f"hardly better than without ({least:.3g} % against {default:.3g} %): keep what you have")
