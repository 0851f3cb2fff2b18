"""Joint angles over the gait cycle: mean and band, left against right, and by the labels of a tier."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.names import is_estimate
from ..replay.metrics import BETWEEN
from ..replay.metrics_joint import JOINT_STATE, cycles_of, joint_columns, starts_from_signal
from ..replay.trajectory import inside, joined
from . import style
from .panels import dress, nothing
from .text import printable
from .views.base import role_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
ROLES = ("reference", "raw", "estimate")
LEAST = 2
"""Fewer cycles have no band."""


class Cycles(NamedTuple):
    """Cycles of one joint from one channel.

    Attributes
    ----------
    owner : str
        Run, or topic of what was measured.
    joint, base, side : str
        Name of the joint; without its side; ``left``, ``right`` or empty.
    label : str
        Of the tier; empty where there is none.
    curves : ndarray, shape (cycles, 101)
        Degrees, from one main maximum of the angle to the next.
    """

    owner: str
    joint: str
    base: str
    side: str
    label: str
    curves: Floats


def side_of(name: str) -> tuple[str, str]:
    """Return a name without its side, and the side: ``knee_angle_r`` gives ``knee_angle``, ``right``."""
    words = re.split(r"([_\W]+)", name)
    for i, word in enumerate(words):
        if word.lower() in SIDES:
            rest = "".join(words[:i] + words[i + 1 :])
            return re.sub(r"([_\W])[_\W]+", r"\1", rest).strip("_ ./-") or name, SIDES[word.lower()]
    return name, ""


def joint_cycles(rec: Recording, tier: pl.DataFrame | None = None) -> list[Cycles]:
    """Return the cycles of every joint of every channel, by label where a tier is given.

    Parameters
    ----------
    rec : Recording
        With joint angles. Cycles begin at the main maxima of the reference's angle, else of the encoder's, else of
        the estimate's, so that all curves of a joint are cut alike.
    tier : polars.DataFrame, optional
        Annotations; a cycle has a label where it lies in one of its intervals whole.
    """
    topics = [t for t, c in rec.channels.items() if c.schema == JOINT_STATE and c.count]
    topics.sort(key=lambda t: ROLES.index(role_of(t)) if role_of(t) in ROLES else 1)
    starts: dict[str, NDArray[np.int64]] = {}
    result = []
    for topic in topics:
        table = rec.table(topic)
        for joint in joint_columns(table):
            rows = table.select("t_ns", joint).filter(pl.col(joint).is_finite()).unique("t_ns").sort("t_ns")
            if rows.height < 3:
                continue
            t_ns, angle = rows["t_ns"].to_numpy(), np.unwrap(rows[joint].cast(pl.Float64).to_numpy())
            if joint not in starts:
                starts[joint] = starts_from_signal(t_ns, angle)
            owner = topic.split("/")[2] if is_estimate(topic) else topic
            base, side = side_of(joint)
            for label, parts in _parts(starts[joint], tier).items():
                curves = np.concatenate([np.empty((0, 101)), *(cycles_of(t_ns, angle, p) for p in parts)])
                curves = np.degrees(curves[np.isfinite(curves).all(axis=1)])
                if len(curves) >= LEAST:
                    result.append(Cycles(owner, joint, base, side, label, curves))
    return result


def _parts(starts: NDArray[np.int64], tier: pl.DataFrame | None) -> dict[str, list[NDArray[np.int64]]]:
    """Return the starts of cycles by label, a list of neighbours each."""
    if tier is None:
        return {"": [starts]}
    parts: dict[str, list[NDArray[np.int64]]] = {}
    for (label,), rows in tier.group_by("label", maintain_order=True):
        spans = joined(np.column_stack((rows["start_ns"].to_numpy(), rows["end_ns"].to_numpy() + 1)))
        parts[str(label)] = [starts[inside(starts, s[None])] for s in spans]
    covered = joined(np.column_stack((tier["start_ns"].to_numpy(), tier["end_ns"].to_numpy() + 1)))
    free = ~inside(starts, covered)
    gap = np.searchsorted(covered[:, 0], starts)
    parts[BETWEEN] = [starts[free & (gap == k)] for k in range(len(covered) + 1)]
    return parts


def strides(rec: Recording, fig: Figure) -> None:
    """Joint angles over the gait cycle: mean and ±1 sd, left against right, beside the reference."""
    _draw(rec, fig, joint_cycles(rec))


def strides_by(rec: Recording, fig: Figure, tier: pl.DataFrame) -> None:
    """Draw joint angles over the gait cycle by the labels of a tier: mean and ±1 sd."""
    _draw(rec, fig, joint_cycles(rec, tier))


def _draw(rec: Recording, fig: Figure, curves: list[Cycles]) -> None:
    if not curves:
        raise nothing(rec, f"no joint with {LEAST} cycles of gait")
    by_label = any(c.label for c in curves)
    rows = list(dict.fromkeys(c.base for c in curves))
    owners = list(dict.fromkeys(c.owner for c in curves)) if by_label else [""]
    fig.set_size_inches(max(6.5, 5.0 * len(owners)), 0.8 + 3.2 * len(rows))
    axes = fig.subplots(len(rows), len(owners), squeeze=False, sharey="row")
    for row, base in zip(axes, rows, strict=True):
        for ax, owner in zip(row, owners, strict=True):
            mine = [c for c in curves if c.base == base and owner in ("", c.owner)]
            if not mine:
                ax.set_axis_off()
                continue
            colours: dict[object, str] = {}
            for c in mine:
                key = (c.label, c.side) if by_label else (c.owner, c.side)
                reference = not by_label and role_of(c.owner) == "reference"
                colours.setdefault(key, style.REFERENCE if reference else style.run_color(len(colours)))
                name = " ".join(w for w in (c.label if by_label else c.owner, c.side) if w)
                _band(ax, c.curves, colours[key], f"{printable(name)}: {len(c.curves)} cycles", reference)
            title = f"{printable(base)}{f' of {printable(owner)}' if owner else ''}"
            dress(ax, title, "gait cycle (%), from maximum to maximum of the angle", "angle (°)")


def _band(ax: Axes, curves: Floats, color: str, label: str, dashed: bool) -> None:
    percent, mean = np.linspace(0.0, 100.0, curves.shape[1]), curves.mean(axis=0)
    sd = curves.std(axis=0, ddof=1)
    ax.plot(percent, mean, "--" if dashed else "-", color=color, linewidth=1.8, label=label)
    ax.fill_between(percent, mean - sd, mean + sd, color=color, alpha=0.18, linewidth=0)
