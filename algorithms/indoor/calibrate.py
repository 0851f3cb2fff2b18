"""``radio``: P_d0 and η of anchors from powers at known positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..calibration import Calibration, Calibrator, Stretch
from ..contract import AlgorithmError, FloatArray, Input
from ..parameters import meta
from .anchors import ATTACHMENT, parse_anchors
from .pathloss import PathLoss, calibrate_by_distances, regress, trimmed_mean

XYZ = ("pos_x", "pos_y", "pos_z")


class RadioParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the calibration."""

    method: Annotated[
        Literal["regression", "source"],
        meta(
            "regression, or the source's way (power at 1 m, mean exponent)",
            "",
            "hybrid indoor positioning, section 4.4.2",
        ),
    ] = "regression"
    drop: Annotated[
        int, meta("samples dropped at each end of a point's powers", "", "hybrid indoor positioning", ge=0)
    ] = 5
    cell_m: Annotated[float, meta("positions nearer than this are one point", "m", "", gt=0)] = 0.1
    least_points: Annotated[int, meta("points that an anchor needs for values of its own", "", "", ge=2)] = 4


class RadioCalibration(Calibrator):
    """Log-distance model by anchor and, pooled, by technology; the points become the radio map.

    Powers of one anchor at one point are one trimmed mean.
    """

    name: ClassVar[str] = "radio"
    title: ClassVar[str] = "P_d0 and η of anchors, and a radio map, from powers at known positions"
    source: ClassVar[str] = "hybrid indoor positioning, section 4.4.2; Rappaport 2002, section 4.11"
    Params: ClassVar[type[msgspec.Struct]] = RadioParams
    inputs = (
        Input("radio", "marcha_msgs/msg/RadioSignal", ("mac", "rssi_dbm"), many=True),
        Input("position", "geometry_msgs/msg/PointStamped", XYZ, optional=True),
        Input("pose", "geometry_msgs/msg/PoseStamped", XYZ, optional=True),
    )

    def calibrate(self, stretches: Sequence[Stretch]) -> Calibration:
        """Return the models.

        Raises
        ------
        AlgorithmError
            No anchor table, no positions, or nothing heard at two distances.
        """
        anchors: dict[str, dict[str, Any]] = {}
        samples: dict[tuple[str, int, int, int], list[float]] = {}
        for stretch in stretches:
            if ATTACHMENT not in stretch.attachments:
                raise AlgorithmError(
                    f"{stretch.label}: no attachment {ATTACHMENT}; convert it with the anchor table"
                )
            for row in parse_anchors(stretch.attachments[ATTACHMENT]):
                anchors.setdefault(row["mac"], row)
            self._collect(stretch, samples)
        points: dict[str, list[tuple[FloatArray, float, float]]] = {}
        for (mac, *cell), powers in samples.items():
            if mac in anchors:
                where = np.array(cell) * self.params.cell_m
                points.setdefault(mac, []).append(
                    (where, trimmed_mean(powers, self.params.drop), float(np.std(powers)))
                )
        if not points:
            raise AlgorithmError("no power of an anchor of the table was heard at a known position")
        return self._result(anchors, points)

    def _collect(self, stretch: Stretch, samples: dict[tuple[str, int, int, int], list[float]]) -> None:
        reference = [t for name in ("position", "pose") for t in stretch.tables.get(name, ())]
        if not reference:
            raise AlgorithmError(
                f"{stretch.label}: no positions of the receiver; name them with --input position=/reference/position"
            )
        t = reference[0]["t_ns"].to_numpy()
        xyz = reference[0].select(XYZ).to_numpy()
        for table in stretch.tables["radio"]:
            at = table["t_ns"].to_numpy()
            inside = (at >= t[0]) & (at <= t[-1])
            where = np.column_stack([np.interp(at - t[0], t - t[0], xyz[:, i]) for i in range(3)])
            cells = np.round(np.nan_to_num(where) / self.params.cell_m).astype(int)
            powers = table["rssi_dbm"].to_numpy()
            for i, mac in enumerate(table["mac"].to_list()):
                if inside[i] and np.isfinite(powers[i]) and powers[i] < 0:
                    key = (mac, int(cells[i, 0]), int(cells[i, 1]), int(cells[i, 2]))
                    samples.setdefault(key, []).append(float(powers[i]))

    def _result(
        self, anchors: dict[str, dict[str, Any]], points: dict[str, list[tuple[FloatArray, float, float]]]
    ) -> Calibration:
        remarks: list[str] = []
        distances = {m: self._distances(anchors[m], found) for m, found in points.items()}
        powers = {m: np.array([p for _, p, _ in found]) for m, found in points.items()}
        pooled: dict[str, dict[str, float]] = {}
        for technology in {anchors[m]["technology"] for m in points}:
            mine = [m for m in points if anchors[m]["technology"] == technology]
            try:
                model = self._model(
                    np.concatenate([distances[m] for m in mine]), np.concatenate([powers[m] for m in mine])
                )
            except AlgorithmError as error:
                remarks.append(f"{technology}: {error}")
                continue
            pooled[technology] = self._values(model, [w for m in mine for *_, w in points[m]])
        out: list[dict[str, Any]] = []
        for mac, found in sorted(points.items()):
            row = anchors[mac]
            one: dict[str, Any] = {k: row[k] for k in ("mac", "technology", "x", "y")} | {"points": []}
            if row["z"] == row["z"]:
                one["z"] = row["z"]
            if len(found) >= self.params.least_points:
                try:
                    model = self._model(distances[mac], powers[mac])
                    one |= self._values(model, [w for *_, w in found])
                    if model.doubt:
                        remarks.append(f"anchor {row['name'] or mac}: {model.doubt}")
                except AlgorithmError as error:
                    remarks.append(f"anchor {row['name'] or mac}: {error}")
            one["points"] = [[float(v) for v in where] + [power] for where, power, _ in found]
            out.append(one)
        own = sum("p_d0" in a for a in out)
        if own < len(anchors):
            remarks.append(
                f"{len(anchors) - own} of {len(anchors)} anchors have pooled values of their technology"
            )
        height = float(np.mean([where[2] for found in points.values() for where, *_ in found]))
        values = {"anchors": out, "pooled": pooled, "height_m": height}
        return Calibration(
            kind=self.name, subject="anchors", values=values, remarks=remarks, usable=bool(pooled)
        )

    def _model(self, d: FloatArray, p: FloatArray) -> PathLoss:
        return regress(d, p) if self.params.method == "regression" else calibrate_by_distances(d, p)

    @staticmethod
    def _values(model: PathLoss, within: Sequence[float]) -> dict[str, float]:
        sigma = float(np.hypot(model.residual_db, np.sqrt(np.mean(np.square(within)))))
        return {"p_d0": model.p_d0_dbm, "eta": model.eta, "residual_db": model.residual_db, "sigma_db": sigma}

    @staticmethod
    def _distances(anchor: dict[str, Any], found: Sequence[tuple[FloatArray, float, float]]) -> FloatArray:
        where = np.array([w for w, *_ in found])
        delta = where - np.array([anchor["x"], anchor["y"], anchor["z"]])
        return np.maximum(np.sqrt((np.nan_to_num(delta) ** 2).sum(axis=1)), 0.1)
