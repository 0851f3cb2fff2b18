"""``indoor.zones``: which zone or room of the plan a position is in, with its probability."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from ..contract import (
    AlgorithmError,
    Annotate,
    Context,
    Input,
    Message,
    Output,
    PlainEstimator,
    Remark,
    Result,
)
from ..parameters import meta
from .floorplan import ATTACHMENT

OUTSIDE = "outside"
RINGS = ((0.0, 1), (0.75, 6), (1.5, 8), (2.3, 8))
"""Points over a two-dimensional Gaussian: radius in standard deviations and number on it, by equal shares."""


class ZoneParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the zones."""

    least: Annotated[
        float, meta("probability that another zone needs before the answer changes", "1", "", ge=0, le=1)
    ] = 0.75


class IndoorZones(PlainEstimator):
    """Zone of each position: the probability of every named area under the stated uncertainty.

    Named areas of the plan are features of kind ``zone`` or ``room`` with a ``name``. The answer changes when another
    zone has at least ``least`` of the probability, so that it does not flicker on a border. Behind an estimator in a
    chain (``indoor.fused+indoor.zones``) or on a channel of positions.
    """

    name: ClassVar[str] = "indoor.zones"
    title: ClassVar[str] = "zone or room of each position, with its probability"
    source: ClassVar[str] = "probability of an area under a Gaussian, by points of equal weight"
    Params: ClassVar[type[msgspec.Struct]] = ZoneParams
    inputs = (
        Input("position", "geometry_msgs/msg/PointStamped", ("pos_x", "pos_y"), stage="indoor.fused"),
        Input("sigma", "marcha_msgs/msg/NavigationSigma", ("sigma_pos_x", "sigma_pos_y"), optional=True),
    )
    outputs = ()

    def start(self, context: Context) -> None:
        """Read the zones of the plan."""
        import shapely

        plan = json.loads(context.attachments[ATTACHMENT]) if ATTACHMENT in context.attachments else {}
        self.zones: dict[str, Any] = {}
        for feature in plan.get("features", ()):
            facts = feature.get("properties") or {}
            if facts.get("kind") in ("zone", "room") and facts.get("name") and feature.get("geometry"):
                self.zones.setdefault(str(facts["name"]), shapely.geometry.shape(feature["geometry"]))
        if not self.zones:
            raise AlgorithmError(
                f"{self.name}: the recording's {ATTACHMENT} names no zone; features of kind zone or room need a name"
            )
        self.names = (*self.zones, OUTSIDE)
        self.outputs = (
            Output(
                "zone",
                "marcha_msgs/msg/NamedValues",
                ("zone", *self.names),
                metadata=(("zones", ", ".join(self.names)),),
            ),
            Output(
                "stay",
                "marcha_msgs/msg/NamedValues",
                ("zone",),
                event=True,
                metadata=(("zones", ", ".join(self.names)),),
                annotate=Annotate("zone", "instant", label="{zone}"),
            ),
        )
        self.sd = np.array([0.5, 0.5])
        self.at = -1
        offsets = [
            (r * np.cos(2 * np.pi * k / n), r * np.sin(2 * np.pi * k / n)) for r, n in RINGS for k in range(n)
        ]
        self.offsets = np.array(offsets)

    def take(self, message: Message) -> Iterable[Result]:
        """Take a position or its standard deviation; a position is answered."""
        if message.input == "sigma":
            sd = np.array(message.values, dtype=np.float64)
            self.sd = np.where(np.isfinite(sd), sd, self.sd)
            return []
        import shapely

        places = np.array(message.values, dtype=np.float64) + self.offsets * self.sd
        free = np.ones(len(places), dtype=bool)
        shares = []
        for area in self.zones.values():
            inside = shapely.contains_xy(area, places[:, 0], places[:, 1]) & free
            free &= ~inside
            shares.append(float(inside.mean()))
        shares.append(float(free.mean()))
        best = int(np.argmax(shares))
        results: list[Result] = []
        if best != self.at and (self.at < 0 or shares[best] >= self.params.least):
            self.at = best
            results.append(Result("stay", message.t_ns, (float(best),)))
        return [Result("zone", message.t_ns, (float(self.at), *shares)), *results]

    def remarks(self) -> list[Remark]:
        """Say nothing: an unknown zone is an answer (``outside``)."""
        return []
