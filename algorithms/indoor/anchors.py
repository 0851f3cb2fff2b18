"""Anchors of known position with the parameters of their signals, from what the recording and calibrations say.

A recording has the attachment ``anchors.csv``: ``mac,technology,x,y,z,p_d0,eta,name,floor`` (m, dBm; cells may be
empty and columns other than ``mac``, ``x``, ``y`` missing). The calibration ``radio`` has what was measured, and
goes before the table. An anchor without parameters of its own gets the pooled ones of its technology; that is said.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import AlgorithmError, Context, FloatArray, Remark
from .storeys import Storeys, storeys_of

ATTACHMENT = "anchors.csv"
COLUMNS = ("mac", "technology", "x", "y", "z", "p_d0", "eta", "name", "floor")
MIDDLE_M = 5.0
"""A usual distance to an anchor: there the power is known best, and errors of P_d0 and η go together."""
LEAST_ETA = 0.3
"""An exponent below this is no model: a range would grow tenfold with 3 dB."""
USUAL_SIGMA_DB = 6.0
"""Standard deviation of one received power about the model, where nothing was measured (Rappaport 2002, table 4.6)."""


@dataclass
class Anchors:
    """Anchors in the order of their numbers.

    Attributes
    ----------
    macs : list of str
        Addresses in lower case.
    technology : list of str
        ``wifi``, ``ble`` …
    position : ndarray
        x, y, z (m) in the plan, shape (n, 3); z is NaN where it is not known.
    p_d0, eta : ndarray
        Parameters of the log-distance model (dBm, 1), shape (n,).
    sigma_db : ndarray
        Standard deviation of one power about the model (dB), shape (n,).
    remarks : list of Remark
        What a user must know of them.
    borrowed : ndarray
        Whether the parameters are pooled ones, shape (n,).
    covariance : ndarray
        Of (P_d0, η) as far as it is known, shape (n, 2, 2); NaN where it is not.
    floor : ndarray
        Number of the floor, NaN where it is not stated, shape (n,).
    """

    macs: list[str]
    technology: list[str]
    position: FloatArray
    p_d0: FloatArray
    eta: FloatArray
    sigma_db: FloatArray
    remarks: list[Remark] = field(default_factory=list)
    borrowed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    floor: FloatArray = field(default_factory=lambda: np.zeros(0))
    number: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.number = {mac: i for i, mac in enumerate(self.macs)}

    def __len__(self) -> int:
        return len(self.macs)

    @property
    def plane(self) -> FloatArray:
        """x, y (m), shape (n, 2)."""
        return self.position[:, :2]

    def above(self, height_m: float) -> FloatArray:
        """Return how far each anchor is above a receiver at ``height_m``, 0 where its height is not known."""
        up = self.position[:, 2] - height_m
        return np.where(np.isnan(up), 0.0, up)

    def storeys(self, context: Context, storey_m: float = 0.0) -> Storeys:
        """Return the floors of the building and the one that each anchor is on; ``storey_m``: 0 as the plan states."""
        floor = self.floor if self.floor.size == len(self) else np.full(len(self), np.nan)
        plan = context.metadata.get("plan", {})
        return storeys_of(self.position[:, 2], floor, context.attachments, plan, storey_m)

    def doubt(self, power_db: float, eta: float) -> FloatArray:
        """Return the covariance of (P_d0, η), shape (n, 2, 2).

        Where none is stated, anchors with values of their own have none, those with pooled ones an independent
        doubt of the power at :data:`MIDDLE_M` and of η.
        """
        lever = 10.0 * math.log10(MIDDLE_M)
        turn = np.array([[1.0, lever], [0.0, 1.0]])
        assumed = turn @ np.diag([power_db**2, eta**2]) @ turn.T
        stated = np.isfinite(self.covariance.sum(axis=(1, 2)))
        own = np.where(self.borrowed[:, None, None], assumed, 0.0)
        return np.where(stated[:, None, None], np.nan_to_num(self.covariance), own)

    @property
    def relative_sigma(self) -> FloatArray:
        """Standard deviation of a range by its length: ln 10 σ / (10 η)."""
        return math.log(10.0) * self.sigma_db / (10.0 * self.eta)


def device_of(metadata: Mapping[str, Mapping[str, str]]) -> str:
    """Return which receiver a recording is of, for its offset: the phone's model, else the logger's name."""
    about = metadata.get("device", {})
    return " ".join(filter(None, (about.get("brand", ""), about.get("phone", "")))) or about.get("name", "")


def parse_anchors(data: bytes, label: str = ATTACHMENT) -> list[dict[str, Any]]:
    """Return the rows of an anchor table; AlgorithmError names the line that does not do."""
    rows = csv.DictReader(io.StringIO(data.decode("utf-8-sig", "replace")))
    missing = [c for c in ("mac", "x", "y") if c not in (rows.fieldnames or ())]
    if missing:
        raise AlgorithmError(f"{label}: no column {missing[0]!r}; an anchor table has {', '.join(COLUMNS)}")
    anchors: list[dict[str, Any]] = []
    for line, row in enumerate(rows, start=2):
        one: dict[str, Any] = {
            "mac": (row.get("mac") or "").strip().lower(),
            "technology": (row.get("technology") or "unknown").strip().lower(),
            "name": (row.get("name") or "").strip(),
        }
        for key in ("x", "y", "z", "p_d0", "eta", "floor"):
            text = (row.get(key) or "").strip()
            try:
                one[key] = float(text) if text else math.nan
            except ValueError:
                raise AlgorithmError(f"{label}, line {line}: {key} {text!r} is not a number") from None
        if not one["mac"] or not (math.isfinite(one["x"]) and math.isfinite(one["y"])):
            raise AlgorithmError(f"{label}, line {line}: an anchor has an address, x and y")
        if any(one["mac"] == other["mac"] for other in anchors):
            raise AlgorithmError(f"{label}, line {line}: {one['mac']} is there twice; keep one")
        anchors.append(one)
    return anchors


def anchors_of(context: Context, *, without: str = "", need_model: bool = True) -> Anchors:
    """Return the anchors that a context knows.

    Parameters
    ----------
    context : Context
        With the attachment ``anchors.csv`` and, where there is one, the calibration ``radio``.
    without : str
        Addresses or names of anchors to leave out, between commas or blanks.
    need_model : bool
        Whether anchors must have P_d0 and η (not for ranges that are measured as such).

    Raises
    ------
    AlgorithmError
        No anchor positions, or no parameters of any anchor; says what to run instead.
    """
    calibration = context.calibrations.get("radio")
    values: Mapping[str, Any] = calibration.values if calibration is not None and calibration.usable else {}
    measured = {str(a["mac"]): a for a in values.get("anchors", ())}
    if ATTACHMENT in context.attachments:
        rows = parse_anchors(context.attachments[ATTACHMENT])
    elif measured and all("x" in a for a in measured.values()):
        rows = [
            {**dict.fromkeys(("z", "p_d0", "eta", "floor"), math.nan), "name": "", **a}
            for a in measured.values()
        ]
    else:
        raise AlgorithmError(
            f"no anchor positions: the recording has no attachment {ATTACHMENT} "
            "(mac,technology,x,y,z,p_d0,eta,name); convert it with the anchor table, or run dead reckoning: "
            "phone.pdr, indoor.pdr"
        )
    out = set(without.replace(",", " ").lower().split())
    unknown = out - {r["mac"] for r in rows} - {r["name"].lower() for r in rows}
    if unknown:
        raise AlgorithmError(f"without: no anchor {min(unknown)!r}; there are {_names(rows)}")
    rows = [r for r in rows if r["mac"] not in out and r["name"].lower() not in out]
    remarks: list[Remark] = []
    flat: list[str] = []
    offset = float(values.get("offsets_db", {}).get(device_of(context.metadata), 0.0))
    for row in rows:
        mine = measured.get(row["mac"])
        row["sigma_db"], row["borrowed"], row["covariance"] = math.nan, False, np.full((2, 2), np.nan)
        if mine is not None:
            if mine.get("eta") is not None and float(mine["eta"]) < LEAST_ETA:
                flat.append(row["name"] or row["mac"])
                mine = {k: v for k, v in mine.items() if k not in ("p_d0", "eta", "sigma_db")}
                row["p_d0"] = row["eta"] = math.nan
            row |= {k: float(mine[k]) for k in ("p_d0", "eta", "sigma_db") if mine.get(k) is not None}
            if "p_d0" in mine and "covariance" in mine:
                row["covariance"] = np.array(mine["covariance"], dtype=np.float64)
            row["p_d0"] += offset
    if flat:
        detail = f"η below {LEAST_ETA:g} of {', '.join(flat[:4])}: powers that do not fall with distance give no ranges"
        remarks.append(
            Remark("flat_anchors", f"{detail}; pooled values are taken, calibrate at other distances")
        )
    pooled = _pooled(rows, values, offset)
    borrowed: dict[str, list[str]] = {}
    for row in rows:
        common = pooled.get(row["technology"]) or pooled.get("")
        if math.isnan(row["p_d0"]) or math.isnan(row["eta"]):
            if common is None and need_model:
                raise AlgorithmError(
                    f"no P_d0 and η of {row['mac']}, nor of any other anchor; calibrate them with "
                    "marcha calibrate radio, or write p_d0 (dBm at 1 m) and eta into the anchor table"
                )
            row["p_d0"], row["eta"] = common[:2] if common else (math.nan, math.nan)
            if prior := spread_of(values, row["technology"]):
                row["covariance"] = prior[1]
            row["borrowed"] = True
            borrowed.setdefault(row["technology"], []).append(row["name"] or row["mac"])
        if math.isnan(row["sigma_db"]):
            row["sigma_db"] = common[2] if common else USUAL_SIGMA_DB
        if need_model and row["eta"] <= 0:
            raise AlgorithmError(
                f"anchor {row['mac']}: η = {row['eta']:g} must be positive; calibrate it again"
            )
    for technology, names in borrowed.items() if need_model else ():
        remarks.append(
            Remark(
                "pooled_anchors",
                f"{len(names)} {technology} anchors without calibration have pooled values: {', '.join(names[:4])}"
                f"{' …' if len(names) > 4 else ''}; calibrate them (marcha calibrate radio)",
            )
        )

    def column(key: str) -> FloatArray:
        return np.array([r[key] for r in rows], dtype=np.float64)

    return Anchors(
        [r["mac"] for r in rows],
        [r["technology"] for r in rows],
        np.column_stack([column(k) for k in "xyz"]) if rows else np.zeros((0, 3)),
        column("p_d0"),
        column("eta"),
        column("sigma_db"),
        remarks,
        np.array([r["borrowed"] for r in rows], dtype=bool),
        np.array([r["covariance"] for r in rows]).reshape(-1, 2, 2),
        column("floor"),
    )


def spread_of(values: Mapping[str, Any], technology: str) -> tuple[FloatArray, FloatArray] | None:
    """Return mean (2,) and covariance (2, 2) of (P_d0, η) over the anchors; None where too few are calibrated."""
    pool = dict(values.get("pooled", {})).get(technology, {})
    if "between" not in pool:
        return None
    return np.array(pool["mean"], dtype=np.float64), np.array(pool["between"], dtype=np.float64)


def _pooled(
    rows: list[dict[str, Any]], values: Mapping[str, Any], offset: float
) -> dict[str, tuple[float, float, float]]:
    """Return (P_d0, η, σ) by technology: as calibrated, else the means of the table's anchors; "" of all."""
    models = {
        str(t): (float(v["p_d0"]) + offset, float(v["eta"]), float(v.get("sigma_db", USUAL_SIGMA_DB)))
        for t, v in dict(values.get("pooled", {})).items()
    }
    for technology in {r["technology"] for r in rows} - set(models):
        stated = [
            (r["p_d0"], r["eta"], r["sigma_db"] if r["sigma_db"] == r["sigma_db"] else USUAL_SIGMA_DB)
            for r in rows
            if r["technology"] == technology and not math.isnan(r["p_d0"]) and not math.isnan(r["eta"])
        ]
        if stated:
            mean = np.mean(stated, axis=0)
            models[technology] = (float(mean[0]), float(mean[1]), float(mean[2]))
    return models


def _names(rows: list[dict[str, Any]]) -> str:
    return ", ".join(r["name"] or r["mac"] for r in rows) or "none"
