"""C3D: markers as points, sensors as analog channels, annotations as events."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np

from ..recording import Recording
from ..recording.annotations import EVENT
from ..recording.errors import UsageError
from ..recording.scratch import scratch_folder
from ..recording.selection import Selection, selected_topics, within
from .facts import origin, pretty
from .files import write_files
from .opensim import MARKERS
from .series import Floats, Together, evenness, rate_hz, together
from .tables import meaning

EVEN = 0.01
"""Intervals may differ by this share before a channel counts as uneven."""

MOST = 255
"""Values in one dimension of a parameter: its size is one byte."""
WORD = 120
"""Bytes of an event's label or context; all of a parameter take as much as the longest."""
ROOM = 90_000
"""Bytes for events: all parameters together have 255 blocks of 512."""


class C3dExporter:
    """C3D file with points in millimetres, analog channels in SI units and events."""

    name: ClassVar[str] = "c3d"
    title: ClassVar[str] = (
        "C3D: markers, sensors as analog channels, annotations as events (Vicon, Mokka, Visual3D)"
    )
    suffix: ClassVar[str] = ".c3d"
    Options: ClassVar[type[msgspec.Struct]] = Selection

    def _data(self, rec: Recording, options: Any) -> tuple[Together | None, Together | None]:
        topics = selected_topics(rec, options)
        markers = [t for t in topics if rec.channels[t].schema == MARKERS and rec.channels[t].count]
        sensors = [
            t
            for t in topics
            if not t.startswith("/estimate/")
            and rec.channels[t].schema
            in ("sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField", "sensor_msgs/msg/JointState")
            and rec.channels[t].count
        ]
        if not markers and not sensors:
            raise UsageError(
                f"{rec.path}: no chosen channel has markers or readings of sensors for a C3D file"
            )
        return (together(rec, markers, options) if markers else None), (
            together(rec, sensors, options) if sensors else None
        )

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what has no place, or only rounded, in the file; the side file names it."""
        points, analog = self._data(rec, options)
        losses = ["64-bit numbers: values are 32-bit, times a frame number; the date and the clock are lost"]
        for data in (points, analog):
            if data is not None and data.resampled:
                losses.append(
                    f"several clocks: {', '.join(data.resampled)} are interpolated to the times of the others"
                )
        if points is None and analog is not None and evenness(analog.t_ns) > EVEN:
            losses.append("uneven times: readings are interpolated to even ones")
        if points is not None and evenness(points.t_ns) > EVEN:
            losses.append("uneven times: frames are numbered, gaps in time are lost")
        if points is not None and analog is not None:
            losses.append(
                "readings between frames: analog channels are interpolated to a multiple of the frame rate"
            )
        if rec.annotations.height:
            losses.append(
                "ends of annotations: an interval becomes two events, LABEL and LABEL end; the rest is in the side file"
            )
        marks = within(rec.annotations, options)
        lead = points or analog
        if lead is not None and marks.height:
            events = _events(marks, int(lead.t_ns[0]))
            if len(events) > MOST:
                losses.append(
                    f"more than {MOST} events in one parameter: the others are in LABELS2, TIMES2 …"
                )
            if left := len(events) - _fitting(events):
                losses.append(f"{left} events, for which the file has no room: they are in the side file")
            if any(len(t.encode()) > WORD for c in ("tier", "label") for t in marks[c].unique().to_list()):
                losses.append(f"labels and tiers longer than {WORD} bytes: cut")
        others = [
            t
            for t, c in rec.channels.items()
            if c.schema != EVENT and not any(d is not None and t in d.columns for d in (points, analog))
        ]
        if others:
            losses.append(f"{len(others)} other channels")
        return losses

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the file and its side file; see :class:`marcha.export.Exporter`."""
        points, analog = self._data(rec, options)
        lead = points or analog
        assert lead is not None
        marks = within(rec.annotations, options)
        data = _encode(lead, points, analog, rec, marks)
        side = {
            **origin(rec),
            "first_frame_ns": int(lead.t_ns[0]),
            "annotations": marks.rows(named=True),
            "not_in_the_file": self.losses(rec, options),
        }
        return write_files(
            {path: data, path.with_name(path.name + ".json"): pretty(side)}, overwrite=overwrite
        )


def _encode(
    lead: Together, points: Together | None, analog: Together | None, rec: Recording, marks: Any
) -> bytes:
    import ezc3d

    file: Any = ezc3d.c3d()
    rate = rate_hz(lead.t_ns) or 1.0
    frames = len(lead.t_ns)
    parameters = file["parameters"]
    parameters["POINT"]["RATE"]["value"] = [rate]
    parameters["POINT"]["UNITS"]["value"] = ["mm"]
    names: list[str] = []
    xyz: list[Floats] = []
    for topic, columns in (points.columns if points else {}).items():
        for name in (n.removesuffix(".x") for n in columns if n.endswith(".x")):
            names.append(name if points and len(points.columns) == 1 else f"{topic}/{name}")
            xyz.append(1000.0 * np.stack([columns[f"{name}.{a}"] for a in "xyz"]))
    file["data"]["points"] = np.ones((4, len(names), frames))
    if names:
        stacked = np.stack(xyz, axis=1)
        hidden = ~np.isfinite(stacked).all(axis=0)
        file["data"]["points"][:3] = stacked
        file["data"]["points"][:, hidden] = np.nan
    parameters["POINT"]["LABELS"]["value"] = names
    ratio = 1
    if analog is not None:
        own = rate_hz(analog.t_ns) or rate
        ratio = max(1, round(own / rate)) if points is not None else 1
        sample_ns = lead.t_ns[0] + np.arange(frames * ratio) * (1e9 / (rate * ratio))
        exact = points is None and evenness(analog.t_ns) <= EVEN
        labels, units, values = [], [], []
        for topic, columns in analog.columns.items():
            for name, column in columns.items():
                labels.append(f"{topic}/{name}".lstrip("/"))
                units.append(meaning(rec.channels[topic].schema, name)["unit"].replace("²", "2"))
                values.append(
                    column
                    if exact
                    else np.interp(sample_ns, analog.t_ns.astype(float), column, left=np.nan, right=np.nan)
                )
        if len(values) > MOST:
            raise UsageError(
                f"{rec.path}: {len(values)} analog channels, a C3D file holds {MOST}; choose fewer with --topic"
            )
        if values:  # a channel whose messages were lost has none
            file["data"]["analogs"] = np.stack(values)[None]
            parameters["ANALOG"]["RATE"]["value"] = [rate * ratio]
            parameters["ANALOG"]["LABELS"]["value"] = labels
            parameters["ANALOG"]["UNITS"]["value"] = units
    _add_events(file, _events(marks, int(lead.t_ns[0])))
    with scratch_folder() as folder:
        file.write(str(folder / "x.c3d"))
        return (folder / "x.c3d").read_bytes()


def _events(marks: Any, zero_ns: int) -> list[tuple[float, str, str]]:
    """Return time [s], context and label of each event; an interval gives two."""
    out = []
    for tier, start, end, label in marks.select("tier", "start_ns", "end_ns", "label").iter_rows():
        text = _word(" ".join(label.split()) or "event")
        out.append(((start - zero_ns) / 1e9, _word(tier), text))
        if end > start:
            out.append(((end - zero_ns) / 1e9, _word(tier), f"{text} end"))
    return sorted(out)


def _word(text: str) -> str:
    return text.encode()[:WORD].decode("utf-8", "ignore")


def _fitting(events: list[tuple[float, str, str]]) -> int:
    """Return how many events the parameters have room for: each word takes as much as the longest one."""
    if not events:
        return 0
    size = max(len(c.encode()) for _, c, _ in events) + max(len(t.encode()) for _, _, t in events) + 8
    return min(len(events), ROOM // size)


def _add_events(file: Any, events: list[tuple[float, str, str]]) -> None:
    """Add the events that fit; each after the first 255 in numbered parameters, as those of many markers."""
    whole = events[: _fitting(events)]
    for number, k in enumerate(range(0, len(whole), MOST), 1):
        part = whole[k : k + MOST]
        mark = "" if number == 1 else str(number)
        if number == 1:
            file.add_parameter("EVENT", "USED", [len(part)])
        file.add_parameter("EVENT", f"CONTEXTS{mark}", [c for _, c, _ in part])
        file.add_parameter("EVENT", f"LABELS{mark}", [label for _, _, label in part])
        times = np.array([[t // 60, t % 60] for t, _, _ in part], float).T
        file.add_parameter("EVENT", f"TIMES{mark}", times)
