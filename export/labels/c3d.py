"""Events of C3D files: instants with a context (left, right, general) and a label."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...recording.errors import MarchaError
from .side import Label

name = "c3d"
suffix = ".c3d"


def sniff(path: Path, head: bytes) -> bool:
    """Return whether the file begins as C3D files do."""
    return len(head) > 512 and head[1] == 0x50 and path.suffix.lower() == ".c3d"


def read(path: Path, data: bytes) -> list[Label]:
    """Return the events of a file; times count from its first frame.

    Raises
    ------
    MarchaError
        The file cannot be read, or its table of events is inconsistent.
    """
    import ezc3d
    import numpy as np

    try:
        file = ezc3d.c3d(str(path), ignore_bad_formatting=True)
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise MarchaError(f"{path}: is not a C3D file that can be read: {reason}") from None
    parameters: Any = file["parameters"]
    if "EVENT" not in parameters:
        return []
    events = parameters["EVENT"]
    used = int(np.ravel(events["USED"]["value"])[0]) if "USED" in events else 0
    if not used:
        return []
    further = [str(n) for n in range(2, len(events)) if f"LABELS{n}" in events]  # beyond 255: LABELS2 …
    if "LABELS" in events and used <= len(events["LABELS"]["value"]):  # else it counts all
        used += sum(len(events[f"LABELS{n}"]["value"]) for n in further)
    words = {
        key: [w for n in ("", *further) if key + n in events for w in events[key + n]["value"]]
        for key in ("LABELS", "CONTEXTS")
    }
    parts = [np.asarray(events[f"TIMES{n}"]["value"], float) for n in ("", *further) if f"TIMES{n}" in events]
    even = parts and all(t.ndim == 2 and len(t) == 2 for t in parts)
    times = np.hstack(parts) if even else np.zeros((0, 0))
    if times.ndim != 2 or times.shape[0] != 2 or times.shape[1] < used or len(words["LABELS"]) < used:
        raise MarchaError(
            f"{path}: EVENT: says {used} events, has {times.shape} times and {len(words['LABELS'])} labels"
        )
    header = file["header"]["points"]
    rate = float(header["frame_rate"]) or 1.0
    first_s = int(header["first_frame"]) / rate
    out = []
    for k in range(used):
        seconds = 60.0 * times[0, k] + times[1, k] - first_s
        if not abs(seconds) < 2**32:
            raise MarchaError(f"{path}: EVENT: time of event {k + 1} is {seconds} s; correct it")
        t_ns = round(seconds * 1e9)
        tier = str(words["CONTEXTS"][k]).strip() if k < len(words["CONTEXTS"]) else ""
        out.append(Label(tier, t_ns, t_ns, str(words["LABELS"][k]).strip()))
    order = sorted(range(len(out)), key=lambda k: (out[k].start_ns, k))
    return [out[k] for k in order]
