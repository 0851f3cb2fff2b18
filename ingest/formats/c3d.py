"""C3D: marker trajectories of any capture system (c3d.org), read by ezc3d in a process of its own.

A damaged C3D can end the process that reads it; here it ends the child, and the user gets one line.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ...recording.errors import MarchaError, UsageError
from ..contract import Import, ReportBuilder
from ..leg import unique_markers
from ..optical import MarkerOptions, marker_import
from ..units import conversion

READ_S = 300.0
"""Longest time that reading a file may take (s)."""

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
head = {"labels": [str(x) for x in labels], "shape": pos.shape, "units": str(units[0]) if len(units) else "",
        "rate_hz": float(c["header"]["points"]["frame_rate"]), "first_frame": int(c["header"]["points"]["first_frame"])}
out = sys.stdout.buffer
out.write(json.dumps(head).encode() + b"\\n")
out.write(pos.tobytes())
"""


class C3d:
    """Importer ``c3d``: ``/reference/markers``."""

    name: ClassVar[str] = "c3d"
    title: ClassVar[str] = "C3D marker trajectories"
    Options = MarkerOptions
    beside: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """The key byte of its header, and that of its parameter section where it says."""
        if len(head) < 1024 or head[1] != 0x50 or not head[0]:
            return 0.0
        at = (head[0] - 1) * 512
        return 0.95 if len(head) < at + 4 or head[at + 3] in (84, 85, 86) else 0.0

    def read(self, paths: Sequence[Path], options: MarkerOptions) -> Import:
        """Read one file."""
        path = paths[0]
        head, pos = _read(path)
        names = [n.strip() for n in head["labels"]][: pos.shape[1]]
        if not names or not len(pos):
            raise MarchaError(f"{path}: holds no marker, or no frame; nothing to convert")
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
        rate = head["rate_hz"]
        if not rate > 0:
            raise MarchaError(f"{path}: its frame rate is {rate:g}; set POINT:RATE")
        t_ns = np.rint((head["first_frame"] + np.arange(len(pos))) * (1e9 / rate)).astype(np.int64)
        device = {"time": "frames at the header's rate; frame 1 is at 0", "rate_hz": f"{rate:g}"}
        return marker_import(t_ns, np.arange(1, len(pos) + 1), names, pos * factor, report, device, options)


def _read(path: Path) -> tuple[dict[str, Any], np.ndarray]:
    """Return header facts and positions (frames, markers, 3) in the file's unit; NaN where not seen."""
    if not path.is_file():
        raise MarchaError(f"{path}: no such file")
    with path.open("rb") as file:
        if file.read(2)[1:] != b"\x50":
            raise MarchaError(f"{path}: not a C3D file: its second byte is not 80")
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
    facts = json.loads(head)
    pos = np.frombuffer(data, "<f8").reshape(facts["shape"]).astype(float)
    return facts, np.where(np.isfinite(pos).all(axis=2, keepdims=True), pos, np.nan)
