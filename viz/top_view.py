"""The view from above: the tracks themselves, seen by a camera so far away that heights do not move them."""

from __future__ import annotations

import numpy as np
import rerun as rr

from .trace import Floats

CAMERA = "/top_view/camera"
GRID = "/top_view/grid"
TICKS = "/top_view/ticks"
PIXELS = 1000.0
"""Width of the camera's picture; only a scale, the viewer zooms into it without loss."""

FAR = 1000.0
"""Height of the camera, as a multiple of the picture's width: ten widths of height move a point by 1 %."""

LINES = 12
"""Most lines of the grid in one direction."""

GREY = (110, 116, 124)


def log_top_view(stream: rr.RecordingStream, low: Floats, high: Floats) -> None:
    """Log the camera above the box from ``low`` to ``high`` (3,), m, and a grid with its metres.

    The camera looks straight down, x to the right and y up, as maps do.
    """
    longest = max(float((high - low)[:2].max()), 2.0)
    spacing = nice(longest / LINES)
    margin = 0.05 * longest
    xs, ys = (
        np.arange(np.floor((a - margin) / spacing), np.ceil((b + margin) / spacing) + 1) * spacing + 0.0
        for a, b in zip(low[:2], high[:2], strict=True)
    )
    width = max(float(np.ptp(xs)), float(np.ptp(ys))) + 3.0 * spacing  # and the names beside the lines
    centre = ((xs[0] + xs[-1]) / 2, (ys[0] + ys[-1]) / 2)
    z = float(low[2])
    stream.log(
        CAMERA,
        rr.Transform3D(translation=[*centre, z + FAR * width], mat3x3=np.diag([1.0, -1.0, -1.0])),
        rr.Pinhole(focal_length=FAR * PIXELS, width=PIXELS, height=PIXELS, image_plane_distance=0.0),
        static=True,
    )
    lines = [[(x, ys[0], z), (x, ys[-1], z)] for x in xs] + [[(xs[0], y, z), (xs[-1], y, z)] for y in ys]
    stream.log(GRID, rr.LineStrips3D(lines, colors=(*GREY, 90), radii=rr.Radius.ui_points(0.5)), static=True)
    beside = 0.4 * spacing  # a name at a line's end would lie on it
    ticks = [(x, ys[0] - beside, z) for x in xs] + [(xs[0] - beside, y, z) for y in ys]
    stream.log(
        TICKS,
        rr.Points3D(
            ticks,
            labels=[f"{v:g} m" for v in (*xs, *ys)],
            colors=GREY,
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        ),
        static=True,
    )


def nice(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not below ``least``."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= least * (1 - 1e-9)))
