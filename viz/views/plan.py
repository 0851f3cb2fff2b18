"""The floor under the tracks: plan, its picture, and the anchors by technology."""

from __future__ import annotations

import numpy as np
import rerun as rr

from .. import style
from ..canvas import OVERVIEW, SPACE, Canvas
from ..floor import FloorPlan, floor_plan, with_calibration

LINE = (150, 156, 164)
BELOW_M = 0.02
"""The picture lies so far below the floor, that lines on it are seen."""


def draw_plan(canvas: Canvas) -> FloorPlan:
    """Draw what the recording's attachments say of the floor, and return it."""
    plan = with_calibration(floor_plan(canvas.attachments), canvas.metadata)
    canvas.plan = plan
    if not plan:
        return plan
    canvas.flat = True
    base = f"{canvas.prefix}/plan"
    if plan.outlines:
        strips = [np.column_stack([line, np.zeros(len(line))]).astype(np.float32) for line in plan.outlines]
        path = f"{base}/outlines"
        canvas.static(path, rr.LineStrips3D(strips, colors=LINE, radii=rr.Radius.ui_points(0.8)))
        canvas.show("space", path, tab=OVERVIEW, panel=SPACE, owner="plan")
    if plan.picture is not None:
        left, right, low, high = plan.corners
        corners = [(left, low), (right, low), (right, high), (left, high)]
        path = f"{base}/picture"
        mesh = rr.Mesh3D(
            vertex_positions=[(x, y, -BELOW_M) for x, y in corners],
            triangle_indices=[(0, 1, 2), (0, 2, 3)],
            vertex_texcoords=[(0, 1), (1, 1), (1, 0), (0, 0)],
            albedo_texture=plan.picture,
        )
        canvas.static(path, mesh)
        canvas.show("space", path, tab=OVERVIEW, panel=SPACE, owner="plan")
    if plan.anchors:
        path = f"{base}/anchors"
        anchors = list(plan.anchors.values())
        colors = technology_colors(a.technology for a in anchors)
        points = rr.Points3D(
            [a.position for a in anchors],
            labels=[f"{a.technology} {a.mac}".strip() for a in anchors],
            colors=[style.rgb(colors[a.technology]) for a in anchors],
            radii=rr.Radius.ui_points(6.0),
            show_labels=len(anchors) <= 16,
        )
        canvas.static(path, points)
        canvas.show("space", path, tab=OVERVIEW, panel=SPACE, owner="anchors")
    return plan


def technology_colors(technologies: object) -> dict[str, str]:
    """Return a colour by technology, in the order in which they are met."""
    names = dict.fromkeys(str(t) for t in technologies)  # type: ignore[attr-defined]
    return {t: style.run_color(i) for i, t in enumerate(names)}
