"""Figures of positions on a floor plan: uncertainty, zones, number of anchors heard; nothing is aligned."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from ..algorithms.contract import FloatArray
from .metrics_place import ELLIPSE95, squared
from .view import PLAN

if TYPE_CHECKING:
    from .view import Comparison, RunView

HEARD_S = 5.0
"""Powers of so many seconds before a position count as heard for it: a window of the source."""
FEW = 20
"""Groups of fewer positions have no figure."""


def indoor(view: RunView) -> dict[str, float]:
    """Errors on a plan: share inside the stated 95 % ellipse, by zone, by number of anchors heard."""
    compared = on_plan(view)
    if compared is None:
        return {}
    metrics = _ellipse(view, compared)
    table = position_errors(view)
    assert table is not None
    for column, name in (("zone", "{}"), ("heard", "heard{}")):
        for key, part in table.filter(pl.col(column).is_not_null()).group_by(column, maintain_order=True):
            if part.height >= FEW and key[0] != "":
                label = name.format(str(key[0]).replace(" ", "_"))
                metrics[f"position_error_mean_m.{label}"] = float(part["error_m"].to_numpy().mean())
    return metrics


def on_plan(view: RunView) -> Comparison | None:
    """Return positions of a run on a plan beside the reference on it, None where one of them is not on it."""
    if view.reference_frame != PLAN or view.lineage.get("frame") != PLAN:
        return None
    return view.compared("none")


def position_errors(view: RunView) -> pl.DataFrame | None:
    """Return every compared position of a run with its error.

    Returns
    -------
    polars.DataFrame or None
        ``t_ns, pos_x, pos_y, error_x_m, error_y_m, error_m`` (m), ``zone`` (that of the true position; null without
        zones) and ``heard`` (anchors heard in the last 5 s; null without an anchor table). None where run or reference
        is not on a plan.
    """
    compared = on_plan(view)
    if compared is None:
        return None
    error, truth = compared.error, compared.reference
    table = pl.DataFrame(
        {
            "t_ns": compared.t_ns,
            "pos_x": compared.estimate[:, 0],
            "pos_y": compared.estimate[:, 1],
            "error_x_m": error[:, 0],
            "error_y_m": error[:, 1],
            "error_m": np.hypot(error[:, 0], error[:, 1]),
        }
    )
    zones = zones_of(view.attachment("plan.geojson"))
    zone = pl.Series("zone", zone_at(zones, truth) if zones else [None] * table.height, dtype=pl.String)
    return table.with_columns(zone, _heard(view, compared.t_ns))


def zones_of(plan: bytes | None) -> dict[str, Any]:
    """Return the areas of a plan that have a name (``zone``, ``room``), as shapely geometries."""
    if plan is None:
        return {}
    import shapely

    zones: dict[str, Any] = {}
    for feature in json.loads(plan).get("features", ()):
        facts = feature.get("properties") or {}
        if facts.get("kind") in ("zone", "room") and facts.get("name") and feature.get("geometry"):
            zones.setdefault(str(facts["name"]), shapely.geometry.shape(feature["geometry"]))
    return zones


def zone_at(zones: Mapping[str, Any], places: FloatArray) -> list[str]:
    """Return the zone of each place (n, 2 or more), the first where several overlap, empty outside of all."""
    import shapely

    names = np.full(len(places), "", dtype=object)
    for name, area in zones.items():
        inside = shapely.contains_xy(area, places[:, 0], places[:, 1]) & (names == "")
        names[inside] = name
    return names.tolist()


def _ellipse(view: RunView, compared: Comparison) -> dict[str, float]:
    """Return the share of true positions inside the stated ellipse, and the mean normalized square."""
    sigma = view.table("sigma")
    if sigma is None or not {"sigma_pos_x", "sigma_pos_y"} <= set(sigma.columns) or sigma.is_empty():
        return {}
    sigma = sigma.unique("t_ns", keep="last", maintain_order=True)
    newest = np.clip(np.searchsorted(sigma["t_ns"].to_numpy(), compared.t_ns, "right") - 1, 0, None)
    sd = sigma.select("sigma_pos_x", "sigma_pos_y").to_numpy()[newest]
    cov = np.zeros((len(sd), 2, 2))
    cov[:, 0, 0], cov[:, 1, 1] = sd[:, 0] ** 2, sd[:, 1] ** 2
    ratio = squared(compared.error[:, :2], cov)
    ratio = ratio[np.isfinite(ratio)]
    if not ratio.size:
        return {}
    return {
        "ellipse95_percent": float(100.0 * np.mean(ratio <= ELLIPSE95)),
        "nees_horizontal": float(ratio.mean()),
    }


def _heard(view: RunView, t_ns: Any) -> pl.Series:
    """Return how many anchors were heard in the last :data:`HEARD_S`."""
    table = view.attachment("anchors.csv")
    topics = view.inputs.get("radio", ())
    if table is None or not topics or view.recording is None:
        return pl.Series("heard", [None] * len(t_ns), dtype=pl.Int64)
    anchors = pl.read_csv(table, infer_schema=False)["mac"].str.to_lowercase().to_list()
    count = np.zeros(len(t_ns), dtype=np.int64)
    radio = pl.concat([view.recording.table(t).select("t_ns", "mac") for t in topics]).sort("t_ns")
    for mac in anchors:
        mine = radio.filter(pl.col("mac") == mac)["t_ns"].to_numpy()
        last = np.searchsorted(mine, t_ns, "right")
        first = np.searchsorted(mine, np.asarray(t_ns) - round(HEARD_S * 1e9), "right")
        count += last > first
    return pl.Series("heard", count)
