"""``indoor.fingerprint``: where the powers of a window are most like those of the survey."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import AlgorithmError, Context, FloatArray, Message, PlainEstimator, Remark, Result
from ..parameters import meta
from .anchors import ATTACHMENT, device_of, parse_anchors
from .places import places_of
from .radio_map import field_of
from .trilateration import POSITION, RADIO, SIGMA

ABSENT_DBM = -100.0
"""Power that stands for a transmitter which is not heard: below what receivers hear."""


class FingerprintParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of fingerprinting."""

    method: Annotated[
        Literal["knn", "map"],
        meta(
            "weighted nearest neighbours among the places, or the most likely point of a continuous radio map",
            "",
            "Bahl and Padmanabhan 2000; Ferris et al. 2006",
        ),
    ] = "map"
    window_s: Annotated[float, meta("length of a window", "s", "", gt=0)] = 5.0
    neighbours: Annotated[
        int, meta("nearest places that are averaged (knn)", "", "Bahl and Padmanabhan 2000", ge=1)
    ] = 3
    power_db: Annotated[
        float,
        meta("standard deviation of a window's mean power beside the map's doubt (map)", "dB", "", gt=0),
    ] = 4.0
    least: Annotated[int, meta("fewest transmitters of the survey that a window must hear", "", "", ge=1)] = 3
    remove_offset: Annotated[
        bool, meta("take the mean difference between receiver and survey off first", "", "")
    ] = False


class IndoorFingerprint(PlainEstimator):
    """Windows of mean powers, compared with the survey of the calibration ``radio``.

    ``knn``: the nearest places by the root mean square difference of powers, weighted by its inverse; a transmitter
    that only one side hears counts with −100 dBm there. ``map``: each transmitter's Gaussian process over the
    floor gives mean and doubt of its power; the answer is the mean of the posterior over the grid, and its
    standard deviation. A place beyond the survey's coverage is never an answer.
    """

    name: ClassVar[str] = "indoor.fingerprint"
    title: ClassVar[str] = (
        "position a window from a survey of signal strengths: nearest neighbours or radio map"
    )
    source: ClassVar[str] = "Bahl and Padmanabhan 2000 (RADAR), section 3; Ferris et al. 2006, section III"
    Params: ClassVar[type[msgspec.Struct]] = FingerprintParams
    presets: ClassVar = {"knn": {"method": "knn"}}
    inputs = (RADIO,)
    outputs = (POSITION, SIGMA)

    def start(self, context: Context) -> None:
        """Read the survey."""
        places = places_of(context)
        heard: dict[str, int] = {}
        for place in places:
            for mac in place.powers:
                heard[mac] = heard.get(mac, 0) + 1
        self.number = {mac: k for k, mac in enumerate(sorted(heard))}
        self.where = np.array([p.where for p in places])
        self.height = float(self.where[:, 2].mean())
        table = np.full((len(places), len(self.number)), np.nan)
        for i, place in enumerate(places):
            for mac, power in place.powers.items():
                table[i, self.number[mac]] = power
        self.table = table
        self.field = None
        if self.params.method == "map":
            self.field = field_of(self.where[:, :2], table, self._anchors(context))
        if len(places) < 3:
            raise AlgorithmError(
                f"a radio map of {len(places)} places gives no positions; survey at least three"
            )
        calibration = context.calibrations["radio"]
        self.offset = float(calibration.values.get("offsets_db", {}).get(device_of(context.metadata), 0.0))
        self.start_ns: int | None = None
        self.powers: dict[int, list[float]] = {}
        self.counts = {"fixes": 0, "few": 0}
        self.unknown: set[str] = set()

    def _anchors(self, context: Context) -> FloatArray:
        """Return x, y of the transmitters (n, 2), NaN where no anchor table has them."""
        places = np.full((len(self.number), 2), np.nan)
        if ATTACHMENT in context.attachments:
            for row in parse_anchors(context.attachments[ATTACHMENT]):
                if row["mac"] in self.number:
                    places[self.number[row["mac"]]] = row["x"], row["y"]
        return places

    def take(self, message: Message) -> Iterable[Result]:
        """Take one power; a window that it is beyond is answered first."""
        length = round(self.params.window_s * 1e9)
        results: list[Result] = []
        if self.start_ns is None:
            self.start_ns = message.t_ns
        if message.t_ns >= self.start_ns + length:
            results = self.answer(self.start_ns + length)
            self.start_ns += (message.t_ns - self.start_ns) // length * length
            self.powers = {}
        mac, power = str(message.values[0]), float(message.values[1])
        if mac not in self.number:
            self.unknown.add(mac)
        elif math.isfinite(power) and power < 0:
            self.powers.setdefault(self.number[mac], []).append(power - self.offset)
        return results

    def answer(self, end_ns: int) -> list[Result]:
        """Return the position of the window."""
        if len(self.powers) < self.params.least:
            self.counts["few"] += 1
            return []
        self.counts["fixes"] += 1
        numbers = np.array(sorted(self.powers))
        heard = np.array([np.mean(self.powers[int(k)]) for k in numbers], dtype=np.float64)
        (x, y), sd = self._nearest(numbers, heard) if self.field is None else self._likely(numbers, heard)
        return [
            Result("position", end_ns, (x, y, self.height)),
            Result("sigma", end_ns, (sd[0], sd[1], np.nan)),
        ]

    def _nearest(self, numbers: Any, heard: FloatArray) -> tuple[FloatArray, FloatArray]:
        here = np.full(self.table.shape[1], np.nan)
        here[numbers] = heard
        either = np.isfinite(here)[None, :] | np.isfinite(self.table)
        difference = np.where(np.isfinite(here), here, ABSENT_DBM) - np.where(
            np.isfinite(self.table), self.table, ABSENT_DBM
        )
        if self.params.remove_offset:
            both = np.isfinite(here)[None, :] & np.isfinite(self.table)
            shift = np.where(both, difference, 0.0).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
            difference = difference - np.where(both, shift[:, None], 0.0)
        rms = np.sqrt(np.where(either, difference**2, 0.0).sum(axis=1) / either.sum(axis=1))
        near = np.argsort(rms, kind="stable")[: self.params.neighbours]
        weight = 1.0 / np.maximum(rms[near], 0.1)
        weight /= weight.sum()
        mean = weight @ self.where[near, :2]
        spread = np.sqrt(weight @ (self.where[near, :2] - mean) ** 2)
        # the grid itself cannot tell more than half the distance to the next place
        own = 0.5 * np.sort(np.linalg.norm(self.where[:, :2] - mean, axis=1))[min(1, len(self.where) - 1)]
        return mean, np.hypot(spread, own)

    def _likely(self, numbers: Any, heard: FloatArray) -> tuple[FloatArray, FloatArray]:
        field = self.field
        assert field is not None
        numbers, heard = numbers[field.covered[numbers]], heard[field.covered[numbers]]
        e = heard[:, None] - field.mean[numbers]
        if self.params.remove_offset and len(numbers):
            e = e - e.mean(axis=0)
        variance = field.sd[numbers] ** 2 + self.params.power_db**2
        nu = 4.0  # Student's t: a blocked path counts little (Lange et al. 1989)
        logs = -0.5 * np.log(variance) - 0.5 * (nu + 1) * np.log1p(e**2 / (nu * variance))
        log = logs.sum(axis=0)
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        mean = weight @ field.grid
        return mean, np.sqrt(np.maximum(weight @ (field.grid - mean) ** 2, 0.01))

    def remarks(self) -> list[Remark]:
        """Say how many windows had no fix, and what the survey does not know."""
        remarks: list[Remark] = []
        if not hasattr(self, "counts"):
            return remarks
        if few := self.counts["few"]:
            whole = few + self.counts["fixes"]
            remarks.append(
                Remark(
                    "too_few_transmitters",
                    f"{few} of {whole} windows hear fewer than {self.params.least} transmitters of the survey: no fix; "
                    "lengthen window_s, or survey again",
                    self.counts["fixes"] == 0,
                )
            )
        if self.unknown:
            remarks.append(
                Remark(
                    "unknown_transmitter", f"{len(self.unknown)} transmitters are not in the survey; left out"
                )
            )
        return remarks
