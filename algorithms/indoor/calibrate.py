"""``radio``: P_d0 and η of anchors, offsets of receivers and a radio map, from powers at known positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..calibration import Calibration, Calibrator, Stretch
from ..contract import AlgorithmError, FloatArray, Input
from ..parameters import meta
from .anchors import ATTACHMENT, device_of, parse_anchors
from .pathloss import PathLoss, calibrate_by_distances, power_dbm, regress, trimmed_mean
from .places import Place, coverage
from .storeys import storeys_of

FEW_ANCHORS = 4
"""Fewer anchors do not say what the anchors of a technology differ by."""
XYZ = ("pos_x", "pos_y", "pos_z")
ROUNDS = 20
"""Of models and receivers' offsets in turn; each settles the offsets to a tenth of what was left."""


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
    cell_m: Annotated[
        float, meta("positions nearer than this are one point; about 2 for surveys by walking", "m", "", gt=0)
    ] = 0.1
    least_points: Annotated[int, meta("points that an anchor needs for values of its own", "", "", ge=2)] = 4


@dataclass
class _Point:
    """Powers of one transmitter at one place by one receiver."""

    where: list[FloatArray] = field(default_factory=list)
    powers: list[float] = field(default_factory=list)


Key = tuple[str, str, tuple[int, int, int]]
"""Receiver, transmitter, cell."""


@dataclass(frozen=True)
class _Mean:
    """A point's mean place, trimmed mean power (dBm) and standard deviation of its powers (dB)."""

    device: str
    where: FloatArray
    power: float
    sd: float
    count: int


class RadioCalibration(Calibrator):
    """Log-distance model by anchor and, pooled, by technology; the points become the radio map.

    Powers of one transmitter at one point are one trimmed mean. Receivers that took part get an offset each, of
    mean 0. Without an anchor table there is the radio map alone.
    """

    name: ClassVar[str] = "radio"
    title: ClassVar[str] = "P_d0 and η of anchors, and a radio map, from powers at known positions"
    source: ClassVar[str] = "hybrid indoor positioning, section 4.4.2; Rappaport 2002, section 4.11"
    Params: ClassVar[type[msgspec.Struct]] = RadioParams
    inputs = (
        Input("radio", "marcha_msgs/msg/RadioSignal", ("mac", "rssi_dbm"), many=True),
        Input("position", "geometry_msgs/msg/PointStamped", XYZ, optional=True, reference=True),
        Input("pose", "geometry_msgs/msg/PoseStamped", XYZ, optional=True, reference=True),
    )

    def calibrate(self, stretches: Sequence[Stretch]) -> Calibration:
        """Return the models and the map.

        Raises
        ------
        AlgorithmError
            No positions, or nothing heard at a known one.
        """
        anchors: dict[str, dict[str, Any]] = {}
        samples: dict[Key, _Point] = {}
        about: dict[str, bytes] = {}
        plan: dict[str, str] = {}
        for stretch in stretches:
            about |= stretch.attachments
            plan |= stretch.metadata.get("plan", {})
            if ATTACHMENT in stretch.attachments:
                for row in parse_anchors(stretch.attachments[ATTACHMENT]):
                    anchors.setdefault(row["mac"], row)
            self._collect(stretch, samples)
        points: dict[str, list[_Mean]] = {}
        for (device, mac, _), point in samples.items():
            mean = trimmed_mean(point.powers, self.params.drop)
            where = np.mean(point.where, axis=0)
            points.setdefault(mac, []).append(
                _Mean(device, where, mean, float(np.std(point.powers)), len(point.powers))
            )
        if not points:
            raise AlgorithmError(
                "nothing was heard at a known position; do times of radio and positions meet?"
            )
        return self._result(anchors, points, self._own_floor(anchors, points, about, plan))

    def _collect(self, stretch: Stretch, samples: dict[Key, _Point]) -> None:
        reference = [t for name in ("position", "pose") for t in stretch.tables.get(name, ())]
        if not reference:
            raise AlgorithmError(
                f"{stretch.label}: no positions of the receiver below /reference/; name them: --input position=TOPIC"
            )
        device = device_of(stretch.metadata)
        t = reference[0]["t_ns"].to_numpy()
        xyz = reference[0].select(XYZ).to_numpy()
        for table in stretch.tables["radio"]:
            t_ns = table["t_ns"].to_numpy()
            inside = (t_ns >= t[0]) & (t_ns <= t[-1])
            where = np.column_stack([np.interp(t_ns - t[0], t - t[0], xyz[:, i]) for i in range(3)])
            where = np.nan_to_num(where)
            cells = np.round(where / self.params.cell_m).astype(int).tolist()
            powers = table["rssi_dbm"].to_numpy()
            for i, mac in enumerate(table["mac"].to_list()):
                if inside[i] and np.isfinite(powers[i]) and powers[i] < 0:
                    x, y, z = cells[i]
                    point = samples.setdefault((device, mac, (x, y, z)), _Point())
                    point.where.append(where[i])
                    point.powers.append(float(powers[i]))

    @staticmethod
    def _own_floor(
        anchors: dict[str, dict[str, Any]],
        points: dict[str, list[_Mean]],
        attachments: Mapping[str, bytes],
        plan: Mapping[str, str],
    ) -> dict[str, list[_Mean]]:
        """Return the points of each anchor that are on its own floor: a slab's loss is no loss of distance."""
        rows = list(anchors.values())
        z, floor = (np.array([r[key] for r in rows], dtype=np.float64) for key in ("z", "floor"))
        storeys = storeys_of(z, floor, attachments, plan)
        index = dict(zip(anchors, storeys.of_anchor.tolist(), strict=True))
        return {
            mac: [p for p in means if storeys.at(p.where[2:3])[0] == index[mac]]
            for mac, means in points.items()
            if mac in anchors
        }

    def _result(
        self,
        anchors: dict[str, dict[str, Any]],
        points: dict[str, list[_Mean]],
        own_floor: dict[str, list[_Mean]],
    ) -> Calibration:
        remarks: list[str] = []
        measured = {m: means for m, means in own_floor.items() if means}
        offsets = self._offsets(anchors, measured)
        pooled: dict[str, dict[str, Any]] = {}
        for technology in sorted({anchors[m]["technology"] for m in measured}):
            mine = [m for m in measured if anchors[m]["technology"] == technology]
            try:
                pooled[technology] = self._fit([(anchors[m], measured[m]) for m in mine], offsets)[0]
            except AlgorithmError as error:
                remarks.append(f"{technology}: {error}")
        out: list[dict[str, Any]] = []
        for mac, means in sorted(measured.items()):
            row = anchors[mac]
            one: dict[str, Any] = {k: row[k] for k in ("mac", "technology", "x", "y")} | {"points": []}
            if row["z"] == row["z"]:
                one["z"] = row["z"]
            if len(means) >= self.params.least_points:
                try:
                    values, doubt = self._fit([(row, means)], offsets)
                    one |= values
                    if doubt:
                        remarks.append(f"anchor {row['name'] or mac}: {doubt}")
                except AlgorithmError as error:
                    remarks.append(f"anchor {row['name'] or mac}: {error}")
            one["points"] = [
                [*map(float, p.where), p.power - offsets.get(p.device, 0.0)] for p in points[mac]
            ]
            out.append(one)
        for technology, values in pooled.items():
            fits = np.array(
                [(a["p_d0"], a["eta"]) for a in out if a["technology"] == technology and "p_d0" in a]
            )
            if len(fits) >= FEW_ANCHORS:
                values["mean"], values["between"] = fits.mean(axis=0).tolist(), np.cov(fits.T).tolist()
        own = sum("p_d0" in a for a in out)
        if not anchors:
            remarks.append("no anchor table: a radio map of fingerprints only, no ranges")
        elif own < len(anchors):
            remarks.append(
                f"{len(anchors) - own} of {len(anchors)} anchors have pooled values of their technology"
            )
        places = self._places(points, offsets)
        area = coverage([p.where for p in places])
        remarks.append(
            f"radio map of {len(places)} places, {len(points)} transmitters, {area['area_m2']:.0f} m²; within it the "
            f"nearest place is {area['median_m']:.1f} m away (median), {area['most_m']:.1f} m at most"
        )
        height = float(np.mean([p.where[2] for means in points.values() for p in means]))
        values = {
            "anchors": out,
            "pooled": pooled,
            "height_m": height,
            "offsets_db": offsets,
            "places": [p.as_dict() for p in places],
            "coverage": area,
        }
        return Calibration(kind=self.name, subject="", values=values, remarks=remarks, usable=True)

    def _places(self, points: dict[str, list[_Mean]], offsets: dict[str, float]) -> list[Place]:
        """Return what was heard at each place, by all transmitters."""
        heard_in: dict[tuple[int, ...], list[tuple[str, _Mean]]] = {}
        for mac, means in points.items():
            for mean in means:
                cell = tuple(np.round(mean.where / self.params.cell_m).astype(int).tolist())
                heard_in.setdefault(cell, []).append((mac, mean))
        places = []
        for heard in heard_in.values():
            where = np.mean([m.where for _, m in heard], axis=0)
            powers: dict[str, list[_Mean]] = {}
            for mac, mean in heard:
                powers.setdefault(mac, []).append(mean)
            dbm = {
                mac: float(
                    np.average(
                        [m.power - offsets.get(m.device, 0.0) for m in ms], weights=[m.count for m in ms]
                    )
                )
                for mac, ms in powers.items()
            }
            places.append(Place(where, dbm, max(m.count for _, m in heard)))
        return places

    def _offsets(
        self, anchors: dict[str, dict[str, Any]], measured: dict[str, list[_Mean]]
    ) -> dict[str, float]:
        """Return each receiver's offset (dB), of mean 0, where several took part: models and offsets in turn."""
        devices = sorted({p.device for means in measured.values() for p in means})
        offsets = dict.fromkeys(devices, 0.0)
        if len(devices) < 2:
            return offsets
        for _ in range(ROUNDS):
            left: dict[str, list[float]] = {d: [] for d in devices}
            for mac, means in measured.items():
                if len(means) < self.params.least_points:
                    continue
                d = self._distances(anchors[mac], means)
                corrected = np.array([p.power - offsets[p.device] for p in means])
                model = regress(d, corrected)
                residual = corrected - power_dbm(d, model.p_d0_dbm, model.eta)
                for p, r in zip(means, residual.tolist(), strict=True):
                    left[p.device].append(r)
            offsets = {d: offsets[d] + (float(np.mean(left[d])) if left[d] else 0.0) for d in devices}
            middle = float(np.mean(list(offsets.values())))
            offsets = {d: v - middle for d, v in offsets.items()}
        return offsets

    def _fit(
        self, parts: Sequence[tuple[dict[str, Any], list[_Mean]]], offsets: dict[str, float]
    ) -> tuple[dict[str, Any], str]:
        """Return the model's values of anchors taken together, and what is doubtful about it."""
        d = np.concatenate([self._distances(anchor, means_of) for anchor, means_of in parts])
        means = [p for _, means_of in parts for p in means_of]
        powers = np.array([p.power - offsets.get(p.device, 0.0) for p in means])
        model = self._model(d, powers)
        within = float(np.sqrt(np.mean(np.square([p.sd for p in means]))))
        values: dict[str, Any] = {
            "p_d0": model.p_d0_dbm,
            "eta": model.eta,
            "residual_db": model.residual_db,
            "within_db": within,
            "sigma_db": float(np.hypot(model.residual_db, within)),
        }
        if model.covariance is not None and np.isfinite(model.covariance).all():
            values["covariance"] = model.covariance.tolist()
        return values, model.doubt

    def _model(self, d: FloatArray, p: FloatArray) -> PathLoss:
        return regress(d, p) if self.params.method == "regression" else calibrate_by_distances(d, p)

    @staticmethod
    def _distances(anchor: dict[str, Any], means: Sequence[_Mean]) -> FloatArray:
        delta = np.array([p.where for p in means]) - np.array([anchor["x"], anchor["y"], anchor["z"]])
        return np.maximum(np.sqrt((np.nan_to_num(delta) ** 2).sum(axis=1)), 0.1)
