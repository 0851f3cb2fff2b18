"""C3D: marker trajectories of any capture system (c3d.org), read by ezc3d in a process of its own.

A damaged C3D can end the process that reads it; here it ends the child, and the user gets one line.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..contract import ChannelSpec, Import, ReportBuilder
from ..leg import unique_markers
from ..optical import MarkerOptions, blocks_of, marker_import, marker_table
from ..timestamps import MOST_NS, nanoseconds, possible_rate
from ..units import conversion

READ_S = 300.0
"""Longest time that reading a file may take (s)."""

_MIPS = b"\x56"
"""Fourth byte of the parameter section of a file of a MIPS processor; 84 is Intel, 85 DEC."""

_CHILD = """
import json, sys
import ezc3d
import numpy as np
c = ezc3d.c3d(sys.argv[1])
point = c["parameters"]["POINT"]
keys = sorted((k for k in point if k.startswith("LABELS")), key=lambda k: int(k[6:] or 1))
labels = [label for key in keys for label in point[key]["value"]]
pos = np.ascontiguousarray(c["data"]["points"][:3].transpose(2, 1, 0), dtype="<f8")
units = point.get("UNITS", {}).get("value", [""])
analog, event = c["parameters"].get("ANALOG", {}), c["parameters"].get("EVENT", {})
words = lambda group, key: [str(x) for k in sorted(group) if k.startswith(key) and (k[len(key):] or "1").isdigit()
                            for x in group[k]["value"]]
signals = np.ascontiguousarray(c["data"]["analogs"][0].T, dtype="<f8")
further = [str(n) for n in range(2, len(event)) if f"LABELS{n}" in event]  # beyond 255: LABELS2 …
times = [np.asarray(event[f"TIMES{n}"]["value"], float) for n in ("", *further) if f"TIMES{n}" in event]
times = np.hstack(times) if times and all(t.ndim == 2 and len(t) == 2 for t in times) else np.zeros((2, 0))
used = int(np.ravel(event.get("USED", {}).get("value", [0]))[0]) if "USED" in event else 0
if "LABELS" in event and used <= len(event["LABELS"]["value"]):  # else it counts all
    used += sum(len(event[f"LABELS{n}"]["value"]) for n in further)
head = {"analog": words(analog, "LABELS"), "analog_units": words(analog, "UNITS"), "analog_shape": signals.shape,
        "analog_rate_hz": float(c["header"]["analogs"]["frame_rate"]),
        "events": used, "event_labels": words(event, "LABELS"), "event_contexts": words(event, "CONTEXTS"),
        "event_s": (60.0 * times[0] + times[1]).tolist() if times.ndim == 2 and len(times) == 2 else [],
        "labels": [str(x) for x in labels], "shape": pos.shape, "units": str(units[0]) if len(units) else "",
        "rate_hz": float(c["header"]["points"]["frame_rate"]), "first_frame": int(c["header"]["points"]["first_frame"])}
out = sys.stdout.buffer
out.write(json.dumps(head).encode() + b"\\n")
out.write(pos.tobytes())
out.write(signals.tobytes())
"""


class C3d:
    """Importer ``c3d``: ``/reference/markers``, analog channels, and events as annotations."""

    name: ClassVar[str] = "c3d"
    title: ClassVar[str] = "C3D: markers, analog channels, events"
    Options = MarkerOptions
    beside: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """The key byte of its header, and that of its parameter section where it says."""
        if len(head) < 1024 or head[1] != 0x50 or not head[0]:
            return 0.0
        offset = (head[0] - 1) * 512
        return 0.95 if len(head) < offset + 4 or head[offset + 3] in (84, 85, 86) else 0.0

    def read(self, paths: Sequence[Path], options: MarkerOptions) -> Import:
        """Read one file."""
        path = paths[0]
        head, pos, signals = _read(path)
        names = [n.strip() for n in head["labels"]][: pos.shape[1]]
        if not len(pos) or not (pos.shape[1] or signals.shape[1]):
            raise MarchaError(
                f"{path}: holds neither marker nor analog channel, or no frame; nothing to convert"
            )
        names = unique_markers(names, path, 1)
        if len(names) < pos.shape[1]:
            names += [f"marker{k + 1}" for k in range(len(names), pos.shape[1])]
        try:
            factor, _ = conversion(head["units"] or "mm", "m")
        except UsageError as error:
            raise MarchaError(f"{path}: POINT:UNITS: {error}") from None
        report = ReportBuilder()
        if not head["units"]:
            report.note("unit_doubt", "POINT:UNITS is missing: positions taken for mm, as C3D has by default")
        if len(pos) < head["stated_frames"]:
            report.loss(
                "header_doubt",
                f"the header states {head['stated_frames']} frames, {len(pos)} are there: the file is cut off",
            )
        rate = head["rate_hz"]
        possible_rate(rate, path, "set POINT:RATE")
        t_ns = nanoseconds(head["first_frame"] + np.arange(len(pos)), 1e9 / rate)
        device = {"time": "frames at the header's rate; frame 1 is at 0", "rate_hz": f"{rate:g}"}
        analog = _analog(path, head, signals)
        if pos.shape[1]:
            frame = pl.DataFrame({"t": t_ns, "line": np.arange(1, len(pos) + 1)})
            frame = frame.hstack(marker_table(names, pos * factor))
            markers = marker_import([frame], names, report, device, options)
            channels, blocks = list(markers.channels), markers.blocks()
        else:
            channels, blocks = [], iter(())
        analog_rate = possible_rate(head["analog_rate_hz"] or rate, path, "set ANALOG:RATE")
        frame_ns = nanoseconds(
            head["first_frame"] * (1e9 / rate) + np.arange(len(signals)) * (1e9 / analog_rate), 1.0
        )
        lines = np.arange(1, len(signals) + 1)
        rows = blocks_of([(frame_ns, lines, [(s.topic, t) for s, t in analog])], report)
        return Import(
            channels=[*channels, *(spec for spec, _ in analog)],
            blocks=chain(blocks, rows if analog else ()),
            report=report,
            metadata={"device": {"clock": "device", "frames": "as the capture system has them", **device}},
            annotations=_events(path, head),
        )


def _analog(path: Path, head: dict[str, Any], signals: np.ndarray) -> list[tuple[ChannelSpec, pl.DataFrame]]:
    """Return analog channels: inertial ones (``foot/imu1/acc_x``) as readings, others as values under their labels."""
    labels = [n.strip() for n in head["analog"]][: signals.shape[1]]
    labels += [f"analog{k + 1}" for k in range(len(labels), signals.shape[1])]
    units = [u.strip() for u in head["analog_units"]] + [""] * len(labels)
    groups: dict[str, dict[str, int]] = {}
    for k, label in enumerate(labels):
        topic, _, column = label.rpartition("/")
        groups.setdefault(topic, {})[column] = k
    channels: list[tuple[ChannelSpec, pl.DataFrame]] = []
    others: list[int] = []
    for topic, columns in groups.items():
        schema = next(
            (s for s, sets in _SENSORS.items() if topic and any(set(columns) == c for c in sets)), None
        )
        if schema is None:
            others += columns.values()
            continue
        table = {}
        for column, k in columns.items():
            try:
                factor, _ = conversion(units[k], _SENSOR_UNITS[column.partition("_")[0]])
            except UsageError as error:
                raise MarchaError(f"{path}: ANALOG:UNITS of {labels[k]}: {error}") from None
            table[column] = signals[:, k] * factor
        channels.append((ChannelSpec(f"/{topic}", schema, "", tuple(table)), pl.DataFrame(table)))
    if others:
        names = unique_markers([labels[k] for k in others], path, 1)
        about = {f"unit.{n}": units[k] for n, k in zip(names, others, strict=True) if units[k]}
        values = pl.DataFrame({n: signals[:, k] for n, k in zip(names, others, strict=True)})
        channels.append(
            (ChannelSpec("/analog/values", "marcha_msgs/msg/NamedValues", "", tuple(names), about), values)
        )
    return channels


def _events(path: Path, head: dict[str, Any]) -> pl.DataFrame | None:
    """Return events as instants; a context (left, right, general) is their tier."""
    used, seconds, labels = head["events"], head["event_s"], head["event_labels"]
    if not used:
        return None
    if len(seconds) < used or len(labels) < used or not all(abs(t) * 1e9 <= MOST_NS for t in seconds[:used]):
        raise MarchaError(
            f"{path}: EVENT: says {used} events, has {len(seconds)} times and {len(labels)} labels; "
            "remove the group or export the file again"
        )
    contexts = [c.strip() for c in head["event_contexts"]] + [""] * used
    t_ns = pl.Series(nanoseconds(seconds[:used], 1e9))
    tiers = [c or "events" for c in contexts[:used]]
    return pl.DataFrame(
        {"tier": tiers, "start_ns": t_ns, "end_ns": t_ns, "label": [x.strip() for x in labels[:used]]}
    )


_XYZ = {k: {f"{k}_{a}" for a in "xyz"} for k in ("acc", "gyr", "mag")}
_SENSORS = {
    "sensor_msgs/msg/Imu": (_XYZ["acc"] | _XYZ["gyr"], _XYZ["acc"], _XYZ["gyr"]),
    "sensor_msgs/msg/MagneticField": (_XYZ["mag"],),
}
_SENSOR_UNITS = {"acc": "m/s²", "gyr": "rad/s", "mag": "T"}


def _read(path: Path) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Return header facts, positions (frames, markers, 3) in the file's unit, NaN where not seen, and analog
    signals (samples, channels).
    """
    if not path.is_file():
        raise MarchaError(f"{path}: no such file")
    with path.open("rb") as file:
        start = file.read(10)
        if start[1:2] != b"\x50":
            raise MarchaError(f"{path}: not a C3D file: its second byte is not 80")
        file.seek(max(start[0] - 1, 0) * 512 + 3)
        if file.read(1) == _MIPS:
            raise MarchaError(
                f"{path}: numbers of a MIPS or SGI processor (byte 4 of the parameters is 86), which ezc3d does not "
                "read; save it in the PC (Intel) format, in Mokka: File, Export, C3D"
            )
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", _CHILD, str(path)], capture_output=True, timeout=READ_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise MarchaError(f"{path}: reading it took more than {READ_S:g} s: a damaged C3D file?") from None
    head, _, data = done.stdout.partition(b"\n")
    if done.returncode:
        messages = done.stderr.decode("utf-8", "replace").strip().splitlines()
        why = (
            messages[-1][:120]
            if messages and done.returncode > 0
            else f"its reader ended with signal {-done.returncode}"
        )
        raise MarchaError(f"{path}: a damaged C3D file ({why}); export it again")
    # Names of markers are in whatever encoding the system had; other bytes than UTF-8 become a question mark.
    facts = json.loads(json.dumps(json.loads(head), ensure_ascii=False).encode("utf-8", "replace"))
    first, last = np.frombuffer(start[6:], "<u2").tolist() if len(start) == 10 else (1, 0)
    facts["stated_frames"] = last - first + 1  # ezc3d states those that it found
    size = int(np.prod(facts["shape"]))
    numbers = np.frombuffer(data, "<f8")
    pos = numbers[:size].reshape(facts["shape"]).astype(float)
    signals = numbers[size:].reshape(facts["analog_shape"]).astype(float)
    return facts, np.where(np.isfinite(pos).all(axis=2, keepdims=True), pos, np.nan), signals
