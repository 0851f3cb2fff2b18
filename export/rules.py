"""Annotations by rule, from what estimators and sensors say: the same recording gives the same table.

A rule looks at one channel (or at the steps of one run) and returns intervals. Its annotations have the
source ``algorithm:rule.NAME@VERSION``; applied again, they replace those of their own kind, and what a
replay has written already is not said twice.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from importlib.metadata import version
from typing import Any, NamedTuple

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.annotations import COLUMNS, check_annotations, identified
from ..recording.errors import UsageError
from ..recording.names import ESTIMATE
from ..recording.selection import Selection

STANCE = "marcha_msgs/msg/Stance"
STEP = "marcha_msgs/msg/Step"
FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
Times = NDArray[np.int64]
Bools = NDArray[np.bool_]

TURN_DEG = 45.0
"""A turn changes the direction by at least this much (El-Gohary et al. 2014)."""
TURN_STEP_DEG = 10.0
"""Between two steps of a turn the direction changes by at least this much; less is going straight."""
STAIR_M = 0.08
"""A step on stairs gains or loses at least this much: half a flat riser."""
STAIR_STEPS = 2
"""So many steps on stairs in a row are a flight."""
JUMP_SHARE = 0.4
"""In flight the specific force is below this share of gravity."""
JUMP_S = 0.15
"""Shorter flights are swings of a foot."""
GAP_TIMES = 3.0
"""A gap is longer than this many usual intervals."""
FIX_S = 5.0
"""Without a fix for longer than this, and than :data:`GAP_TIMES` usual intervals, it is lost."""
CLIP_SAMPLES = 2
"""So many readings in a row at the largest value are clipping."""
GRAVITY = 9.80665


class RuleMarks(NamedTuple):
    """What a rule found in one channel: tier, channel, intervals and their labels."""

    tier: str
    channel: str
    start_ns: Times
    end_ns: Times
    labels: list[str]
    metadata: list[dict[str, Any]] | None = None


Rule = Callable[[Recording, Selection], Iterator[RuleMarks]]


def apply_rules(
    rec: Recording, names: Collection[str] = (), *, selection: Selection | None = None
) -> tuple[pl.DataFrame, list[str]]:
    """Return the annotations that rules add to a recording, and the ids of those that they replace.

    Parameters
    ----------
    rec : Recording
        What they look at.
    names : collection of str
        Keys of :data:`RULES`; all by default.
    selection : Selection, optional
        Topics and time to look at.

    Raises
    ------
    UsageError
        An unknown rule.
    """
    for name in names:
        if name not in RULES:
            raise UsageError(f"rule {name!r}: not known; there are {', '.join(RULES)}")
    chosen = names or tuple(RULES)
    ruled = by_rules(rec, chosen, selection or Selection())
    old = rec.annotations
    key = ["tier", "start_ns", "end_ns", "label"]
    add = ruled.join(old, on=key, how="anti", maintain_order="left").select(*COLUMNS)
    own = pl.any_horizontal(
        pl.lit(False), *(pl.col("source").str.starts_with(_source(n, "")) for n in chosen)
    )
    stale = old.filter(own.fill_null(False)).join(ruled, on=key, how="anti")
    if selection is not None and not (selection.whole and not selection.topics):
        stale = stale.clear()  # a part was looked at: what lies elsewhere still holds
    return add, stale["id"].to_list()


def by_rules(rec: Recording, names: Collection[str], selection: Selection) -> pl.DataFrame:
    """Return the annotations of rules, each with its id, by start time."""
    tables = []
    for name in names:
        for marks in RULES[name](rec, selection):
            if not len(marks.start_ns):
                continue
            facts = marks.metadata or [{} for _ in marks.labels]
            tables.append(
                pl.DataFrame({"start_ns": marks.start_ns, "end_ns": marks.end_ns}).with_columns(
                    tier=pl.lit(marks.tier),
                    label=pl.Series(marks.labels, dtype=pl.String),
                    metadata=pl.Series([msgspec.json.encode(f).decode() for f in facts], dtype=pl.String),
                    source=pl.lit(_source(name, version("marcha"))),
                    channel=pl.lit(marks.channel),
                )
            )
    whole = pl.concat(tables) if tables else pl.DataFrame(schema=COLUMNS)
    return identified(check_annotations(whole)).sort("start_ns", maintain_order=True)


def _source(name: str, tool: str) -> str:
    return f"algorithm:rule.{name}@{tool}"


def _topics(rec: Recording, schema: str, selection: Selection, *, estimates: bool) -> Iterator[str]:
    from ..recording.selection import selected_topics

    for topic in selected_topics(rec, selection):
        if rec.channels[topic].schema == schema and topic.startswith(ESTIMATE) == estimates:
            yield topic


def _run(topic: str) -> str:
    return topic.removeprefix(ESTIMATE).rpartition("/")[0]


def _stretches(true: Bools) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last index of each stretch of true values."""
    edges = np.diff(true.astype(np.int8), prepend=np.int8(0), append=np.int8(0))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


def _table(rec: Recording, topic: str, selection: Selection) -> pl.DataFrame:
    return rec.table(topic, start_ns=selection.start_ns, end_ns=selection.end_ns)


def stances(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Stances: from the first to the last still sample, tier ``<run>/stance``."""
    for topic in _topics(rec, STANCE, selection, estimates=True):
        table = _table(rec, topic, selection)
        t_ns = table["t_ns"].to_numpy()
        first, last = _stretches(table["still"].to_numpy())
        yield RuleMarks(f"{_run(topic)}/stance", topic, t_ns[first], t_ns[last], ["stance"] * len(first))


def swings(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Swings: from the last still sample of a stance to the first of the next, tier ``<run>/swing``."""
    for stance in stances(rec, selection):
        start, end = stance.end_ns[:-1], stance.start_ns[1:]
        tier = f"{stance.tier.removesuffix('stance')}swing"
        yield RuleMarks(tier, stance.channel, start, end, ["swing"] * len(start))


def steps(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Steps as the estimator counts them, tier ``<run>/step``."""
    for topic in _topics(rec, STEP, selection, estimates=True):
        table = _table(rec, topic, selection)
        facts = [
            {k: f"{row[k]:.6g}" for k in ("heading_rad", "height_m", "index", "length_m")}
            for row in table.iter_rows(named=True)
        ]
        labels = [f"step {i}" for i in table["index"]]
        yield RuleMarks(
            f"{_run(topic)}/step",
            topic,
            table["start_ns"].to_numpy(),
            table["end_ns"].to_numpy(),
            labels,
            facts,
        )


def turns(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Turns between steps: at least :data:`TURN_DEG` in one direction without a straight step between.

    From the end of the last step of the old direction to the start of the first of the new one.
    """
    for topic in _topics(rec, STEP, selection, estimates=True):
        table = _table(rec, topic, selection)
        heading = table["heading_rad"].to_numpy()
        start, end = table["start_ns"].to_numpy(), table["end_ns"].to_numpy()
        change = np.rad2deg(np.angle(np.exp(1j * np.diff(heading))))
        begins, ends, labels, facts = [], [], [], []
        for sign, word in ((1.0, "turn left"), (-1.0, "turn right")):
            for i, j in zip(*_stretches(sign * change >= TURN_STEP_DEG), strict=True):
                angle = float(change[i : j + 1].sum())
                if abs(angle) >= TURN_DEG:
                    begins.append(end[i])
                    ends.append(start[j + 1])
                    labels.append(word)
                    facts.append({"angle_deg": f"{angle:.1f}", "steps": str(j - i + 1)})
        yield _in_order(f"{_run(topic)}/turn", topic, begins, ends, labels, facts)


def stairs(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Flights of stairs: at least :data:`STAIR_STEPS` steps in a row that gain, or lose, height."""
    for topic in _topics(rec, STEP, selection, estimates=True):
        table = _table(rec, topic, selection)
        height = table["height_m"].to_numpy()
        start, end = table["start_ns"].to_numpy(), table["end_ns"].to_numpy()
        begins, ends, labels, facts = [], [], [], []
        for sign, word in ((1.0, "stairs up"), (-1.0, "stairs down")):
            for i, j in zip(*_stretches(sign * height >= STAIR_M), strict=True):
                if j - i + 1 >= STAIR_STEPS:
                    begins.append(start[i])
                    ends.append(end[j])
                    labels.append(word)
                    facts.append({"height_m": f"{height[i : j + 1].sum():.3f}", "steps": str(j - i + 1)})
        yield _in_order(f"{_run(topic)}/stair", topic, begins, ends, labels, facts)


def jumps(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Jumps: the specific force stays below :data:`JUMP_SHARE` of gravity for :data:`JUMP_S` or longer."""
    for topic in _topics(rec, IMU, selection, estimates=False):
        if "acc_x" not in rec.channels[topic].columns:
            continue
        table = _table(rec, topic, selection)
        t_ns = table["t_ns"].to_numpy()
        norm = np.linalg.norm(table.select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
        first, last = _stretches(norm < JUMP_SHARE * GRAVITY)
        seconds = (t_ns[last] - t_ns[first]) * 1e-9
        kept = seconds >= JUMP_S
        facts = [
            {"flight_s": f"{s:.3f}", "height_m": f"{GRAVITY * s * s / 8:.3f}"} for s in seconds[kept].tolist()
        ]
        yield RuleMarks(
            f"jump{topic}", topic, t_ns[first[kept]], t_ns[last[kept]], ["jump"] * len(facts), facts
        )


def gaps(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Gaps of a sensor: more than :data:`GAP_TIMES` usual intervals between two readings."""
    for topic in _topics(rec, IMU, selection, estimates=False):
        t_ns = _table(rec, topic, selection)["t_ns"].to_numpy()
        yield _gaps(f"gap{topic}", topic, t_ns, 0.0, "gap")


def _gaps(tier: str, topic: str, t_ns: Times, least_s: float, label: str) -> RuleMarks:
    steps = np.diff(t_ns)
    usual = float(np.median(steps)) if len(steps) else 0.0
    gap_rows = (
        np.flatnonzero(steps > max(GAP_TIMES * usual, least_s * 1e9)) if usual > 0 else np.zeros(0, np.intp)
    )
    return RuleMarks(tier, topic, t_ns[gap_rows], t_ns[gap_rows + 1], [label] * len(gap_rows))


def clips(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Clipping: an axis stays at its largest (or smallest) value for :data:`CLIP_SAMPLES` readings."""
    for topic in _topics(rec, IMU, selection, estimates=False):
        table = _table(rec, topic, selection)
        t_ns = table["t_ns"].to_numpy()
        for group in ("acc", "gyr"):
            names = [f"{group}_{a}" for a in "xyz" if f"{group}_{a}" in table.columns]
            full = np.zeros(len(t_ns), bool)
            for name in names:
                values = table[name].to_numpy()
                if not np.isfinite(values).any():
                    continue
                for limit in (np.nanmax(values), np.nanmin(values)):
                    first, last = _stretches(values == limit)
                    for i, j in zip(first, last, strict=True):
                        if j - i + 1 >= CLIP_SAMPLES and _saturated(values, float(limit)):
                            full[i : j + 1] = True
            first, last = _stretches(full)
            yield RuleMarks(f"clip{topic}", topic, t_ns[first], t_ns[last], [f"clip {group}"] * len(first))


def _saturated(values: NDArray[np.float64], limit: float) -> bool:
    """Return whether readings run into the limit: they come with speed, and it is far from their usual size.

    A sensor at rest also repeats its largest value, and so does one that lies still most of the time.
    """
    if abs(limit) <= 1.2 * float(np.nanmedian(np.abs(values))):
        return False
    first, last = _stretches(values == limit)
    before, after = values[np.maximum(first - 1, 0)], values[np.minimum(last + 1, len(values) - 1)]
    jump = np.nanmax(np.abs(np.concatenate((before - limit, after - limit))), initial=0.0)
    return bool(jump > 0.02 * abs(limit))


def lost_fixes(rec: Recording, selection: Selection) -> Iterator[RuleMarks]:
    """Stretches without a fix: longer than :data:`FIX_S` and than :data:`GAP_TIMES` usual intervals."""
    for topic in _topics(rec, FIX, selection, estimates=False):
        table = _table(rec, topic, selection)
        if "status" in table.columns:
            table = table.filter(pl.col("status") >= 0)
        yield _gaps(f"fix{topic}", topic, table["t_ns"].to_numpy(), FIX_S, "fix lost")


def _in_order(
    tier: str, topic: str, begins: list[Any], ends: list[Any], labels: list[str], facts: list[dict[str, Any]]
) -> RuleMarks:
    start, end = np.array(begins, np.int64), np.array(ends, np.int64)
    order = np.argsort(start, kind="stable")
    return RuleMarks(
        tier,
        topic,
        start[order],
        np.maximum(end, start)[order],
        [labels[k] for k in order],
        [facts[k] for k in order],
    )


RULES: dict[str, Rule] = {
    "stance": stances,
    "swing": swings,
    "step": steps,
    "turn": turns,
    "stair": stairs,
    "jump": jumps,
    "gap": gaps,
    "clip": clips,
    "fix-lost": lost_fixes,
}
"""Rules by name."""
