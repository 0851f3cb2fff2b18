"""Figures of segments beside the source's: attitudes, jump diagram, cross gains, errors as bars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.names import is_estimate
from ..replay.evaluate import evaluate
from . import style
from .panels import TIME, dress, nothing, run_color, seconds
from .text import printable
from .views.common import EULER, euler_deg
from .views.joint import segment_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

ABOVE = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 5, "frameon": False}
ACCELEROMETER, GYROSCOPE = "#cdb4e8", "#c9a227"


def _runs(rec: Recording, output: str, column: str = "") -> dict[str, str]:
    """Return the topics of an output by run, in the recording's order; those with a column, where it is named."""
    return {
        t.split("/")[2]: t
        for t, c in rec.channels.items()
        if is_estimate(t) and t.endswith(f"/{output}") and c.count and (not column or column in c.columns)
    }


def single_sensor_deg(t: Floats, acc: Floats, gyr: Floats) -> tuple[Floats, Floats]:
    """Return roll, pitch and yaw by the accelerometer (yaw NaN) and by the gyroscope alone, both (n, 3), degrees.

    Roll = atan2(a_y, a_z), pitch = atan2(−a_x, √(a_y² + a_z²)); the gyroscope's rates are integrated axis by axis
    (source eq 7) from the accelerometer's mean over the first half second.
    """
    roll = np.arctan2(acc[:, 1], acc[:, 2])
    pitch = np.arctan2(-acc[:, 0], np.hypot(acc[:, 1], acc[:, 2]))
    by_acc = np.stack([roll, pitch, np.full(len(t), np.nan)], axis=1)
    first = acc[t <= t[0] + 0.5].mean(axis=0)
    start = [np.arctan2(first[1], first[2]), np.arctan2(-first[0], np.hypot(first[1], first[2])), 0.0]
    step = 0.5 * np.diff(t, prepend=t[0])[:, None] * (gyr + np.vstack([gyr[:1], gyr[:-1]]))
    return np.degrees(by_acc), np.degrees(start + np.cumsum(np.nan_to_num(step), axis=0))


def attitude(rec: Recording, fig: Figure) -> None:
    """Roll, pitch and yaw of every segment: accelerometer, gyroscope alone, every run, reference where there is one."""
    runs = _runs(rec, "attitude")
    names = list(dict.fromkeys(n for t in runs.values() for n in rec.channels[t].columns))
    angles = [tuple(n.rsplit("_", 1)) for n in names if n.rsplit("_", 1)[-1] in EULER and "_" in n]
    if not angles:
        raise nothing(rec, "no attitude of a segment (run joint.sme, joint.smea, joint.local …)")
    fig.set_size_inches(10.0, 1.2 + 2.6 * len(angles))
    axes = fig.subplots(len(angles), 1, squeeze=False, sharex=True)[:, 0]
    for ax, (segment, axis) in zip(axes, angles, strict=True):
        k, shown = EULER.index(axis), []
        if (imu := f"/leg/{segment}/imu") in rec.channels:
            table = rec.table(imu)
            parts = [table.select(f"{q}_{a}" for a in "xyz").to_numpy() for q in ("acc", "gyr")]
            by_acc, by_gyr = single_sensor_deg(table["t_ns"].to_numpy() / 1e9, *parts)
            t = seconds(rec, table["t_ns"])
            ax.plot(t, by_acc[:, k], color=ACCELEROMETER, linewidth=0.6, label="accelerometer")
            ax.plot(t, by_gyr[:, k], color=GYROSCOPE, linewidth=0.9, linestyle="--", label="gyroscope alone")
        for topic, channel in rec.channels.items():
            if channel.schema == "geometry_msgs/msg/QuaternionStamped" and topic.startswith("/reference/"):
                if segment_of(topic) != segment or not channel.count:
                    continue
                table = rec.table(topic)
                turn = table.select(f"quat_{a}" for a in "wxyz").to_numpy()
                shown.append(euler_deg(turn)[:, k])
                ax.plot(
                    seconds(rec, table["t_ns"]),
                    shown[-1],
                    color=style.REFERENCE,
                    linewidth=1.6,
                    label="reference",
                )
                break
        for run, topic in runs.items():
            if f"{segment}_{axis}" in rec.channels[topic].columns:
                table = rec.table(topic)
                shown.append(np.degrees(table[f"{segment}_{axis}"].to_numpy()))
                ax.plot(
                    seconds(rec, table["t_ns"]),
                    shown[-1],
                    color=run_color(rec, run),
                    linewidth=1.1,
                    label=printable(run),
                )
        _frame(ax, shown)
        note = "" if any(line.get_label() == "reference" for line in ax.get_lines()) else ", no reference"
        dress(ax, f"{printable(segment)} {axis}{note}", TIME, "°", legend=ABOVE)


def _frame(ax: Axes, curves: list[Floats]) -> None:
    """Frame the runs and the reference: what drifts away or spikes leaves the picture."""
    values = np.concatenate(curves)
    low, high = np.nanpercentile(values, (0.5, 99.5))
    room = max(5.0, 0.35 * (high - low))
    ax.set_ylim(low - room, high + room)


def transitions(rec: Recording, fig: Figure) -> None:
    """Jump diagram: every state that occurs with its share of the time, every transition with its number."""
    runs = {r: t for r, t in _runs(rec, "jump", "state").items() if "states" in rec.channels[t].metadata}
    if not runs:
        raise nothing(rec, "no named states (joint.smp, joint.sme, joint.smea)")
    fig.set_size_inches(6.0 * len(runs), 5.6)
    for ax, (run, topic) in zip(fig.subplots(1, len(runs), squeeze=False)[0], runs.items(), strict=True):
        names = [printable(n.strip()) for n in rec.channels[topic].metadata["states"].split(",")]
        state = rec.table(topic)["state"].to_numpy()
        state = state[np.isfinite(state)].astype(int)
        seen = np.unique(state)
        names, state = [names[k] for k in seen], np.searchsorted(seen, state)
        count = np.zeros((len(names), len(names)), int)
        np.add.at(count, (state[:-1], state[1:]), 1)
        colors = [style.run_color(k) for k in seen]
        turn = np.pi / 2 - 2 * np.pi * np.arange(len(names)) / len(names)
        place = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        for a, b in zip(*np.nonzero(count * (1 - np.eye(len(names), dtype=int))), strict=True):
            ax.annotate(
                "",
                place[b],
                place[a],
                arrowprops={
                    "arrowstyle": "->",
                    "connectionstyle": "arc3,rad=0.18",
                    "shrinkA": 36,
                    "shrinkB": 36,
                },
            )
            way = place[b] - place[a]
            side = 0.5 * (place[a] + place[b]) + 0.14 * np.array([way[1], -way[0]])
            ax.text(*side, str(count[a, b]), ha="center", va="center", fontsize=9)
        for k, name in enumerate(names):
            share = 100.0 * float(np.mean(state == k)) if len(state) else 0.0
            ax.scatter(*place[k], s=4200, color=colors[k], alpha=0.35, zorder=2)
            text = f"{name}\n{share:.0f} %\nstays {count[k, k]}"
            ax.text(*place[k], text, ha="center", va="center", fontsize=9, zorder=3)
        ax.set(xlim=(-1.6, 1.6), ylim=(-1.6, 1.6), aspect="equal", xticks=[], yticks=[])
        ax.set_xlabel("arrows: number of changes, from sample to sample", fontsize=9)
        ax.set_title(f"{printable(run)}: jumps over {len(state)} samples", fontsize=10, loc="left")


def cross(rec: Recording, fig: Figure) -> None:
    """Cross gains: share of each angle's correction from foreign rows, plain and weighted by the innovation."""
    runs = _runs(rec, "cross")
    if not runs:
        raise nothing(rec, "no cross gains (joint.sme, joint.smea)")
    fig.set_size_inches(10.0, 1.2 + 3.0 * len(runs))
    for ax, (run, topic) in zip(fig.subplots(len(runs), 1, squeeze=False)[:, 0], runs.items(), strict=True):
        table = rec.table(topic)
        t = seconds(rec, table["t_ns"])
        plain = [c for c in table.columns if not c.startswith("t_") and not c.endswith("_weighted")]
        for k, name in enumerate(plain):
            share = 100.0 * table[name].to_numpy()
            label = f"{printable(name)} {np.nanmean(share) if np.isfinite(share).any() else np.nan:.1f} %"
            weighted = f"{name}_weighted"
            if weighted in table.columns and np.isfinite(table[weighted].to_numpy()).any():
                label += f" (weighted {100.0 * np.nanmean(table[weighted].to_numpy()):.1f} %)"
            color = style.run_color(k)
            ax.plot(t, share, ".", markersize=1.5, alpha=0.4, color=color)
            ax.plot(t, running_mean(t, share, 1.0), linewidth=1.2, color=color, label=label)
        ax.set_ylim(-5.0, 105.0)
        dress(
            ax,
            printable(run),
            f"{TIME}; line: mean over 1 s",
            "foreign rows (%)",
            legend={**ABOVE, "ncols": 2},
        )


def running_mean(t: Floats, values: Floats, width_s: float) -> Floats:
    """Return the mean (n,) of the finite values (n,) within ∓ half of ``width_s``; NaN where there is none."""
    good = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(good, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(good)])
    a, b = np.searchsorted(t, t - 0.5 * width_s), np.searchsorted(t, t + 0.5 * width_s, side="right")
    some = count[b] > count[a]
    return np.where(some, (total[b] - total[a]) / np.maximum(1, count[b] - count[a]), np.nan)


def rmse(rec: Recording, fig: Figure) -> None:
    """RMSE of every run as bars: joints, and roll and pitch of the segments, to the reference."""
    errors: dict[str, dict[str, float]] = {}
    runs = evaluate(rec, intervals=False).runs if any(map(is_estimate, rec.channels)) else []
    for run in runs:
        for metric, value in run.metrics.items():
            if metric.startswith("rmse_deg."):
                errors.setdefault(metric.partition(".")[2], {})[run.run] = float(value)
    if not errors:
        raise nothing(rec, "no joint angle or attitude with a reference")
    owners = list(dict.fromkeys(run for values in errors.values() for run in values))
    fig.set_size_inches(max(6.0, 1.2 * len(errors) * max(1, len(owners)) ** 0.5 + 3.0), 4.6)
    ax, width = fig.subplots(), 0.8 / len(owners)
    for i, run in enumerate(owners):
        places = [k for k, values in enumerate(errors.values()) if run in values]
        height = [values[run] for values in errors.values() if run in values]
        bars = ax.bar(
            np.array(places) + (i - 0.5 * (len(owners) - 1)) * width,
            height,
            0.92 * width,
            color=run_color(rec, run),
            label=printable(run),
        )
        ax.bar_label(bars, fmt="%.2f", fontsize=7)
    ax.set_xticks(range(len(errors)), [printable(n).replace("_", "\n") for n in errors])
    dress(ax, "RMSE to the reference, bias included, after 1.2 s", "", "°", legend=ABOVE)
    ax.set_xlabel("angle", fontsize=9)
    ax.margins(y=0.2)
