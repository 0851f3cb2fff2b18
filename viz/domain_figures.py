"""Figures of phones, of radio indoors and of joints, by name; :func:`marcha.viz.save_figure` writes them.

Each takes a recording and an empty figure, and raises UsageError where the recording has nothing for it.
Channels are found by message type and columns, never by the name of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.names import is_estimate
from ..replay.evaluate import evaluate
from ..replay.references import shown_reference
from . import indoor_figures, joint_figures, plan_figures, style
from .canvas import PLACES
from .curve import Curve
from .floor import Anchor, plan_of
from .panels import MOST_ELLIPSES, TIME, dress, nothing, run_color, seconds
from .phone_figures import detector, street_map, transform
from .shapes import ELLIPSE95, circle, geo_circle, metres_a_degree
from .stance_figures import conditions
from .stride_figures import strides
from .text import printable
from .thinned import acc_norm, every, pieces, thinned
from .trace import Trace, compared, distance
from .views.base import role_of
from .views.joint import difference

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
JOINT, NAMED = "sensor_msgs/msg/JointState", "marcha_msgs/msg/NamedValues"


def _topics(rec: Recording, needs: Sequence[str], *schemas: str, role: str = "") -> list[str]:
    """Return the topics with these columns, of these message types, in this role."""
    return [
        t
        for t, c in rec.channels.items()
        if set(needs) <= set(c.columns)
        and (not schemas or c.schema in schemas)
        and (not role or role_of(t) == role)
        and c.count
    ]


def _require(rec: Recording, what: str, topics: list[str]) -> list[str]:
    if not topics:
        raise nothing(rec, f"no {what}")
    return topics


def _owner(topic: str) -> str:
    return printable(topic.split("/")[2] if is_estimate(topic) else topic)


def _color(rec: Recording, topic: str) -> str:
    if is_estimate(topic):
        return run_color(rec, topic.split("/")[2])
    return style.REFERENCE if role_of(topic) == "reference" else style.DEVICE


def _rows(fig: Figure, count: int) -> list[Axes]:
    fig.set_size_inches(10.0, 1.2 + 2.6 * count)
    return list(fig.subplots(count, 1, squeeze=False)[:, 0])


def _with_norm(table: pl.DataFrame, names: Sequence[str]) -> Floats:
    values = table.select(names).to_numpy()
    return np.column_stack((values, np.linalg.norm(values, axis=1)))


def signals(rec: Recording, fig: Figure) -> None:
    """Accelerometer and gyroscope of every sensor by axis, with the norm."""
    panels = [
        (t, key, unit)
        for key, unit in (("acc", "m/s²"), ("gyr", "rad/s"))
        for t in _topics(rec, [f"{key}_x"], "sensor_msgs/msg/Imu", role="raw")
    ]
    _require(rec, "inertial sensor", [t for t, *_ in panels])
    for ax, (topic, key, unit) in zip(_rows(fig, len(panels)), panels, strict=True):
        names = [f"{key}_{a}" for a in "xyz"]
        t_ns, values = thinned(rec, topic, partial(_with_norm, names=names))
        t = seconds(rec, t_ns)
        for i, a in enumerate("xyz"):
            ax.plot(t, values[:, i], color=style.AXES[i], linewidth=0.8, label=a)
        ax.plot(t, values[:, 3], color=style.NORM, linewidth=0.8, label="norm")
        dress(ax, f"{printable(topic)} {key}", TIME, unit)


def steps(rec: Recording, fig: Figure) -> None:
    """Steps on the norm of the accelerometer, their lengths, and the distance so far."""
    topics = _require(rec, "steps", _topics(rec, ["length_m"], "marcha_msgs/msg/Step"))
    top, lengths, way = _rows(fig, 3)
    sensors = _topics(rec, ["acc_x"], "sensor_msgs/msg/Imu", role="raw")
    norm: tuple[Floats, Floats] | None = None
    if sensors:
        t_ns, values = thinned(rec, sensors[0], acc_norm)
        norm = seconds(rec, t_ns), values[:, 0]
        top.plot(*norm, color=style.NORM, linewidth=0.7, label=f"‖acc‖ of {printable(sensors[0])}")
    for topic in topics:
        table, color = rec.table(topic), _color(rec, topic)
        t, length = seconds(rec, table["t_ns"]), table["length_m"].to_numpy()
        height = np.interp(t, *norm) if norm else np.ones(len(t))
        top.plot(t, height, "d", color=color, markersize=4, label=f"{_owner(topic)}: {len(t)} steps")
        edges = np.arange(len(t) + 1) + 0.5
        lengths.stairs(length, edges, fill=True, color=color, alpha=0.7, label=_owner(topic))
        way.step(np.arange(1, len(t) + 1), np.nancumsum(length), color=color, label=_owner(topic))
    dress(top, "steps along the norm", TIME, "m/s²")
    lengths.set_ylim(top=1.3 * lengths.get_ylim()[1])  # room for the legend
    dress(lengths, "step lengths", "step", "m")
    dress(way, "distance so far", "step", "m")


def heading(rec: Recording, fig: Figure) -> None:
    """Magnetometer in the plane of the phone, and headings, raw and filtered."""
    headings = [
        (t, c)
        for t in _topics(rec, [], NAMED, role="estimate")
        if t.endswith("/heading")
        for c in rec.channels[t].columns
        if c.endswith("_rad")
    ]
    _require(rec, "heading", [t for t, _ in headings])
    fields = _topics(rec, ["mag_x"], "sensor_msgs/msg/MagneticField")[:1]
    axes = _rows(fig, 1 + len(fields))
    for ax, topic in zip(axes, fields, strict=False):
        table = rec.table(topic)
        for i, a in enumerate("xy"):
            ax.plot(
                seconds(rec, table["t_ns"]), table[f"mag_{a}"].to_numpy() * 1e6, color=style.AXES[i], label=a
            )
        dress(ax, f"{printable(topic)}", TIME, "µT")
    for i, (topic, column) in enumerate(headings):
        table = rec.table(topic).filter(pl.col(column).is_finite())
        turned = np.degrees(np.unwrap(table[column].to_numpy()))
        name = f"{_owner(topic)} {column.removesuffix('_rad')}"
        axes[-1].plot(
            seconds(rec, table["t_ns"]), turned, color=style.axis_color(i), linewidth=1.0, label=name
        )
    dress(axes[-1], "heading (unwrapped)", TIME, "°")
    axes[-1].legend(fontsize=7, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.18))  # many lines: below


def fixes(rec: Recording, fig: Figure) -> None:
    """Fixes with their accuracy, stated tracks and reference: in degrees, and in metres about the first."""
    topics = _require(rec, "fixes", _topics(rec, ["lat_deg", "lon_deg"]))
    fig.set_size_inches(13.0, 6.0)
    degrees, metres = fig.subplots(1, 2)
    first: Floats | None = None
    for topic in topics:
        table = rec.table(topic).filter(pl.col("lat_deg").is_finite() & pl.col("lon_deg").is_finite())
        if table.is_empty():
            continue
        place, color = table.select("lat_deg", "lon_deg").to_numpy(), _color(rec, topic)
        first = np.array(place[0] if first is None else first)
        line, look = "-" if is_estimate(topic) else "", {"color": color, "label": _owner(topic)}
        scale = metres_a_degree(first[:1])[0]
        degrees.plot(place[:, 1], place[:, 0], linestyle=line, marker=".", **look)
        local = (place - first) * scale
        metres.plot(local[:, 1], local[:, 0], linestyle=line, marker=".", **look)
        if "sd_east_m" in table.columns and not is_estimate(topic):
            sd = table.select("sd_east_m", "sd_north_m").to_numpy()
            for ring in (geo_circle(place, sd) - first) * scale:
                metres.plot(ring[:, 1], ring[:, 0], color=color, linewidth=0.5, alpha=0.6)
    dress(degrees, "fixes", "longitude (°)", "latitude (°)")
    degrees.ticklabel_format(useOffset=False)
    degrees.tick_params(axis="x", rotation=20)
    if first is not None:
        degrees.set_aspect(1.0 / np.cos(np.radians(first[0])))
    dress(metres, "about the first fix (circles: ±1σ)", "east (m)", "north (m)")
    metres.set_aspect("equal", adjustable="datalim")


def _traces(rec: Recording) -> dict[str, Trace]:
    traces: dict[str, Trace] = {}
    for topic in _topics(rec, ["pos_x", "pos_y", "pos_z"], *PLACES):
        trace = Trace(_owner(topic), _color(rec, topic))
        for table in pieces(rec, topic):
            position = table.select(pl.col("pos_x", "pos_y"), pl.col("pos_z").fill_nan(0.0)).to_numpy()
            turn = table.select(f"quat_{a}" for a in "wxyz").to_numpy() if "quat_w" in table.columns else None
            trace.add(table["t_ns"].to_numpy(), position, turn)
        if trace.count:
            traces[topic] = trace
    return traces


def floor(rec: Recording, fig: Figure) -> None:
    """Floor plan with anchors by technology, tracks beside the true path, and 95 % ellipses."""
    plan, traces = plan_of(rec), _traces(rec)
    if not plan and not traces:
        raise nothing(rec, "neither plan nor anchors nor tracks")
    fig.set_size_inches(9.0, 7.0)
    ax = fig.subplots()
    plan_figures.draw_floor(ax, plan)
    for topic, trace in traces.items():
        p = trace.positions
        mark = "o" if trace.sparse and is_estimate(topic) else ""
        ax.plot(p[:, 0], p[:, 1], color=trace.color, marker=mark, markersize=3, label=trace.owner)
        stated = f"{topic.rpartition('/')[0]}/sigma"
        if is_estimate(topic) and {"sigma_pos_x", "sigma_pos_y"} <= set(_columns(rec, stated)):
            kept = every(rec, stated, MOST_ELLIPSES)
            axes = ELLIPSE95 * kept.select("sigma_pos_x", "sigma_pos_y").to_numpy()
            for ring in circle(trace.at(kept["t_ns"].to_numpy()), axes):
                ax.plot(ring[:, 0], ring[:, 1], color=trace.color, linewidth=0.5, alpha=0.5)
    dress(ax, "from above (ellipses: 95 %)", "x (m)", "y (m)")


def _columns(rec: Recording, topic: str) -> tuple[str, ...]:
    return rec.channels[topic].columns if topic in rec.channels else ()


def radio(rec: Recording, fig: Figure) -> None:
    """Signal strength by anchor: over time, as histogram, and over the true distance with the model."""
    topic = _require(rec, "radio signals", _topics(rec, ["mac", "rssi_dbm"]))[0]
    table = rec.table(topic)
    anchors = plan_of(rec).anchors
    counts = table.group_by("mac").len().sort("len", "mac", descending=[True, False])["mac"].to_list()
    macs = sorted(counts, key=lambda m: m.lower() not in anchors)[:8]
    truth = next((t for k, t in _traces(rec).items() if role_of(k) == "reference"), None)
    beside = truth is not None and any(m.lower() in anchors for m in macs)
    fig.set_size_inches(6.0 * (2 + beside), 4.5)
    axes = fig.subplots(1, 2 + beside)
    for i, mac in enumerate(macs):
        rows = table.filter(pl.col("mac") == mac)
        rssi, color = rows["rssi_dbm"].cast(pl.Float64).to_numpy(), style.run_color(i)
        look = {"color": color, "label": printable(mac)}
        axes[0].plot(seconds(rec, rows["t_ns"]), rssi, ".", markersize=3, **look)
        axes[1].hist(rssi, bins=np.arange(-110.0, 0.0, 2.0), histtype="step", **look)
        anchor: Anchor | None = anchors.get(mac.lower())
        if beside and truth is not None and anchor is not None:
            gone = np.linalg.norm(truth.at(rows["t_ns"].to_numpy()) - anchor.position, axis=1)
            axes[2].plot(gone, rssi, ".", markersize=3, **look)
            d = np.geomspace(0.5, max(float(gone.max()), 1.0), 60)
            axes[2].plot(d, anchor.p_d0 - 10 * anchor.eta * np.log10(d), color=color, linewidth=1.0)
    dress(axes[0], f"{printable(topic)}, {len(macs)} of {len(counts)} transmitters", TIME, "dBm", legend=None)
    dress(axes[1], "histogram", "dBm", "packets")  # the legend hides least here
    seen = table["rssi_dbm"].cast(pl.Float64)
    axes[1].set_xlim(float(seen.min() or -100.0) - 3, float(seen.max() or 0.0) + 3)  # type: ignore[arg-type]
    if beside:
        dress(
            axes[2], "over the true distance (lines: the anchors' model)", "distance (m)", "dBm", legend=None
        )
        axes[2].set_xscale("log")


def error(rec: Recording, fig: Figure) -> None:
    """Distance to the reference over time, and its distribution; positions as they are, not aligned."""
    traces = _traces(rec)
    results = {}
    for topic, trace in traces.items():
        truth = (
            shown_reference(rec.channels, topic.split("/")[2], rec.metadata) if is_estimate(topic) else None
        )
        result = compared(trace, traces[truth], "none") if truth in traces else None
        if result is not None:
            results[topic] = result
    _require(rec, "track with a reference", list(results))
    fig.set_size_inches(12.0, 4.5)
    over, share = fig.subplots(1, 2)
    for topic, result in results.items():
        far, color = distance(result), traces[topic].color
        over.plot(seconds(rec, result.t_ns), far, color=color, label=_owner(topic))
        ordered = np.sort(far)
        percent = 100.0 * np.arange(1, len(far) + 1) / len(far)
        median, p95 = np.percentile(far, [50, 95])
        name = f"{_owner(topic)}: mean {far.mean():.2f}, median {median:.2f}, 95 % {p95:.2f} m"
        share.step(ordered, percent, color=color, where="post", label=name)
    dress(over, "error of the position (not aligned)", TIME, "m", legend=None)
    dress(share, "distribution", "error (m)", "% of the samples")


def joints(rec: Recording, fig: Figure) -> None:
    """Joint angles beside reference and encoder, and the error within its stated ±1σ."""
    angles: dict[str, list[str]] = {}
    for topic in _require(rec, "joint angles", _topics(rec, [], JOINT)):
        for name in rec.channels[topic].columns:
            if not name.endswith((".vel", ".effort")):
                angles.setdefault(name, []).append(topic)
    estimated = {j for j, topics in angles.items() if any(is_estimate(t) for t in topics)}
    angles = {j: topics for j, topics in angles.items() if not estimated or j in estimated}
    judged = {j for j, topics in angles.items() if j in estimated and not all(map(is_estimate, topics))}
    axes = iter(_rows(fig, len(angles) + len(judged)))
    for joint, topics in angles.items():
        ax = next(axes)
        curves: dict[str, Curve] = {}
        for topic in sorted(
            topics, key=lambda t: ("reference", "annotation", "raw", "estimate").index(role_of(t))
        ):
            table, curves[topic] = rec.table(topic), Curve()
            values = np.degrees(table[joint].to_numpy())
            curves[topic].add(table["t_ns"].to_numpy(), values)
            ax.plot(
                seconds(rec, table["t_ns"]),
                values,
                color=_color(rec, topic),
                linewidth=1.1,
                label=_owner(topic),
            )
        printed = printable(joint)
        dress(ax, f"{printed} angle", TIME, "°")
        if joint not in judged:
            continue
        below = next(axes)
        truth = next(t for t in curves if not is_estimate(t))
        widest = 1.0
        for topic in filter(is_estimate, curves):
            t_ns, wrong = difference(curves[topic], curves[truth])
            t, color = seconds(rec, t_ns), _color(rec, topic)
            rmse = float(np.sqrt(np.mean(wrong**2))) if len(wrong) else np.nan
            widest = max(widest, 1.2 * float(np.percentile(np.abs(wrong), 99.5)) if len(wrong) else 0.0)
            below.plot(t, wrong, color=color, linewidth=1.0, label=f"{_owner(topic)}: RMSE {rmse:.2f}°")
            stated = f"{topic.rpartition('/')[0]}/sigma"
            if joint in _columns(rec, stated):
                table = rec.table(stated)
                sd = np.degrees(table[joint].to_numpy())
                below.fill_between(seconds(rec, table["t_ns"]), -sd, sd, color=color, alpha=0.2, linewidth=0)
                widest = max(widest, 1.2 * float(np.nanmedian(sd)))
        below.set_ylim(-widest, widest)
        dress(below, f"{printed} error to {_owner(truth)} (area: ±1σ)", TIME, "°")


def jumps(rec: Recording, fig: Figure) -> None:
    """State of the jump over time, with the share of each state and the number of changes."""
    topics = [
        t for t in _topics(rec, ["state"], NAMED, role="estimate") if "states" in rec.channels[t].metadata
    ]
    _require(rec, "named states (metadata `states` of a channel with a column `state`)", topics)
    for ax, topic in zip(_rows(fig, len(topics)), topics, strict=True):
        names = [printable(n.strip()) for n in rec.channels[topic].metadata["states"].split(",")]
        table = rec.table(topic).filter(pl.col("state").is_finite())
        t, state = seconds(rec, table["t_ns"]), table["state"].to_numpy()
        edges = np.flatnonzero(np.diff(state)) + 1
        starts, ends = np.concatenate([[0], edges]), np.concatenate([edges, [len(state) - 1]])
        for k, name in enumerate(names):
            mine = [i for i in range(len(starts)) if len(state) and state[starts[i]] == k]
            bars = [(float(t[starts[i]]), float(t[ends[i]] - t[starts[i]])) for i in mine]
            label = f"{name}: {100.0 * float(np.mean(state == k)) if len(state) else 0.0:.0f} %"
            ax.broken_barh(bars, (k - 0.4, 0.8), facecolors=style.run_color(k), label=label)
        ax.set_yticks(range(len(names)), names)
        dress(ax, f"{_owner(topic)}: state, {len(edges)} changes", TIME, "", legend=None)
        ax.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(names), frameon=False)


def cycles(rec: Recording, fig: Figure) -> None:
    """Joint angles over the gait cycle: mean and standard deviation of estimate and reference, every cycle's error."""
    results = [
        (run.run, joint)
        for run in (evaluate(rec, intervals=False).runs if any(map(is_estimate, rec.channels)) else [])
        for joint in run.cycles
    ]
    if not results:
        raise nothing(rec, "no joint angle with a reference over two cycles; without a reference: strides")
    percent = np.arange(101)
    axes = _rows(fig, 2 * len(results))
    for (run, joint), ax, below in zip(results, axes[::2], axes[1::2], strict=True):
        color = _color(rec, f"/estimate/{run}/joint")
        curves = (
            (ax, joint.reference_mean, joint.reference_sd, style.REFERENCE, "reference"),
            (ax, joint.estimate_mean, joint.estimate_sd, color, printable(run)),
            (below, joint.error_mean, joint.error_sd, color, "estimate − reference"),
        )
        for panel, mean, sd, own, label in curves:
            m, s = np.array(mean), np.array(sd)
            panel.plot(percent, m, color=own, linewidth=1.4, label=f"{label}: mean")
            panel.fill_between(percent, m - s, m + s, color=own, alpha=0.2, linewidth=0, label="± sd")
        below.axhline(0.0, color=style.NORM, linewidth=0.8)
        name = printable(joint.joint)
        start = "annotated contacts" if joint.starts == "events" else "main maxima of the reference"
        cycle = f"gait cycle (%), from the {start}"
        dress(ax, f"{name} over {joint.count} cycles", cycle, "°")
        rmse = float(np.mean(joint.rmse))
        dress(below, f"{name}: error, RMSE a cycle {rmse:.2f}° (mean)", cycle, "°")


FIGURES: dict[str, Callable[[Recording, Any], None]] = {
    "signals": signals,
    "steps": steps,
    "heading": heading,
    "fixes": fixes,
    "detector": detector,
    "transform": transform,
    "map": street_map,
    "floor": floor,
    "radio": radio,
    "error": error,
    "joints": joints,
    "cycles": cycles,
    "jumps": jumps,
    "transitions": joint_figures.transitions,
    "attitude": joint_figures.attitude,
    "cross": joint_figures.cross,
    "rmse": joint_figures.rmse,
    "strides": strides,
    "anchors": plan_figures.anchors,
    "triples": plan_figures.triples,
    "points": plan_figures.points,
    "particles": plan_figures.particles,
    "geometry": indoor_figures.geometry,
    "radiomap": indoor_figures.radiomap,
    "ranges": indoor_figures.ranges,
    "powers": indoor_figures.powers,
    "threshold": indoor_figures.threshold,
    "conditions": conditions,
}
"""Figures by name, beside ``walk``."""
