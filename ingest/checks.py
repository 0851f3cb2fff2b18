"""Checks of what a sensor says: full scale, silence, stuck values, units. They report and change nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ceiling import CeilingSearch
from .contract import ReportBuilder

FloatArray = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
"""m/s² in one g (ISO 80000-3)."""

#: Rows of a window that is searched for rest, and the spread of the norm below which it is rest.
REST_ROWS, REST_SPREAD = 50, 0.03
#: Norms at rest (m/s²) that an uncalibrated accelerometer may show.
REST_LOW, REST_HIGH = 9.0, 10.6
#: Angular rate (rad/s) that no limb reaches: 4000 °/s is the widest range that is built into devices.
RATE_HIGH = 70.0
#: So many equal readings in a row are a sensor that stopped answering, not noise.
STALE_ROWS = 4


#: Medians that Earth allows, and what to ask where one lies outside: unit, low, high.
PLAUSIBLE = {
    "pressure_pa": ("Pa", 3e4, 1.2e5),
    "mag": ("T", 5e-6, 1e-3),
    "temperature_c": ("°C", -60.0, 90.0),
}


def check_plausible(
    report: ReportBuilder, topic: str, columns: Mapping[str, FloatArray], lines: NDArray[np.int64]
) -> None:
    """Report ``unit_doubt`` where the median of a pressure, field or temperature is not of this Earth.

    Shapes: each of ``columns`` and ``lines`` (n,); SI units.
    """
    values = {name: columns[name] for name in ("pressure_pa", "temperature_c") if name in columns}
    if all(f"mag_{a}" in columns for a in "xyz"):
        values["mag"] = np.sqrt(sum(columns[f"mag_{a}"] ** 2 for a in "xyz"))
    for name, v in values.items():
        unit, low, high = PLAUSIBLE[name]
        finite = v[np.isfinite(v)]
        if finite.size and not low <= (middle := float(np.median(finite))) <= high:
            report.note(
                "unit_doubt",
                f"{topic} {name}: the median is {middle:.4g} {unit}, not {low:g} … {high:g}: right unit?",
                line=int(lines[0]),
                subject=f"{topic} {name}",
            )


class SensorCheck:
    """Watches one accelerometer and gyroscope (either may be missing) while blocks stream by.

    Reports ``clipped`` (each axis apart), ``all_zero``, ``constant``, ``stale_repeat`` and ``unit_doubt``.

    Parameters
    ----------
    report : ReportBuilder
        Where findings go.
    subject : str
        Name of the sensor, said in every finding.
    columns : sequence of str
        Names of the axes, ``acc_x`` … ``gyr_z``.
    limits : mapping of str to (float, float, str), optional
        For each axis the lowest and highest value that the converter can say, in the units that are fed, and
        the full scale as text.
    """

    def __init__(
        self,
        report: ReportBuilder,
        subject: str,
        columns: Sequence[str],
        *,
        limits: Mapping[str, tuple[float, float, str]] | None = None,
    ) -> None:
        self._report = report
        self._subject = subject
        self._columns = list(columns)
        self._limits = dict(limits or {})
        self._rows = 0
        self._first_line: int | None = None
        self._first: list[float] = []
        self._moved = np.zeros(len(self._columns), dtype=bool)
        self._tail: NDArray[np.float64] | None = None
        self._rest: float | None = None
        self._rest_line: int | None = None
        self._ceilings = {f"gyr_{axis}": CeilingSearch() for axis in "xyz"}
        self._clipped: set[str] = set()

    def feed(self, values: Sequence[NDArray[Any]], lines: NDArray[np.int64]) -> None:
        """Look at a block: one array an axis, in the order of ``columns``, and each row's line."""
        if not len(lines):
            return
        if self._first_line is None:
            self._first_line = int(lines[0])
            self._first = [float(v[0]) for v in values]
        self._rows += len(lines)
        self._clipping(values, lines)
        self._stuck(values, lines)
        for i in np.flatnonzero(~self._moved).tolist():
            self._moved[i] = bool(np.any(values[i] != self._first[i]))

    def feed_si(self, acc: Sequence[FloatArray], gyr: Sequence[FloatArray], lines: NDArray[np.int64]) -> None:
        """Look at the same block in m/s² and rad/s (either may be empty) for doubts about units.

        Shapes: ``acc`` and ``gyr`` three arrays each, (n,), as ``lines``.
        """
        if len(acc) == 3 and self._rest is None:
            n = min(len(lines), 20_000) // REST_ROWS * REST_ROWS
            norm = np.sqrt(acc[0][:n] ** 2 + acc[1][:n] ** 2 + acc[2][:n] ** 2).reshape(-1, REST_ROWS)
            if norm.size:
                mean = norm.mean(axis=1)
                quiet = np.flatnonzero((norm.std(axis=1) < REST_SPREAD * mean) & (mean > 0))
                if quiet.size:
                    self._rest = float(np.median(mean[quiet]))
                    self._rest_line = int(lines[quiet[0] * REST_ROWS])
        for axis, rate in zip("xyz", gyr, strict=False):
            self._ceilings[f"gyr_{axis}"].feed(np.asarray(rate, np.float64), lines)
            wild = np.flatnonzero(np.abs(rate) > RATE_HIGH)
            if wild.size:
                self._report.note(
                    "unit_doubt",
                    f"{self._subject} gyr_{axis}: {rate[wild[0]]:.4g} rad/s is more than any limb does: "
                    "° given as rad?",
                    count=wild.size,
                    line=int(lines[wild[0]]),
                    subject=f"{self._subject} gyr",
                )

    def finish(self, *, scale_hint: str = "") -> None:
        """Report what only the whole stream can tell; ``scale_hint`` is what to check in doubt."""
        if self._rows >= STALE_ROWS:
            for group in ("acc", "gyr"):
                idx = [i for i, c in enumerate(self._columns) if c.startswith(group)]
                stuck = [i for i in idx if not self._moved[i]]
                if not stuck or (all(self._first[i] == 0 for i in idx) and len(stuck) == len(idx)):
                    if stuck:
                        self._report.loss(
                            "all_zero",
                            f"{self._subject} {group}: every value is 0: is the sensor connected?",
                            count=self._rows,
                            line=self._first_line,
                            subject=f"{self._subject} {group}",
                        )
                    continue
                for i in stuck:
                    self._report.loss(
                        "constant",
                        f"{self._subject} {self._columns[i]}: stays at its first value {self._first[i]:g}",
                        count=self._rows,
                        line=self._first_line,
                        subject=f"{self._subject} {self._columns[i]}",
                    )
        for name, search in self._ceilings.items():
            for ceiling, waves, line in search.ceilings() if name not in self._clipped else ():
                self._report.loss(
                    "clipped",
                    f"{self._subject} {name}: {waves} turns flatten near {ceiling:.3g} rad/s, below the nominal "
                    "full scale: the true value is beyond it",
                    count=waves,
                    line=line,
                    subject=f"{self._subject} {name}{'+' if ceiling > 0 else '-'}",
                )
        if self._rest is not None and not REST_LOW <= self._rest <= REST_HIGH:
            g = self._rest / STANDARD_GRAVITY
            if 0.9 < self._rest < 1.1:
                why = "g given as m/s²?"
            elif 90 < self._rest < 106:
                why = "m/s² given as g?"
            else:
                why = scale_hint or "is the scale right?"
            self._report.note(
                "unit_doubt",
                f"{self._subject} acc: norm at rest is {self._rest:.3g} m/s² ({g:.3g} g): {why}",
                line=self._rest_line,
                subject=f"{self._subject} acc",
            )

    def _clipping(self, values: Sequence[NDArray[Any]], lines: NDArray[np.int64]) -> None:
        for name, v in zip(self._columns, values, strict=True):
            if name not in self._limits:
                continue
            low, high, text = self._limits[name]
            if v.max() < high and v.min() > low:
                continue
            clipped = np.flatnonzero((v >= high) | (v <= low))
            if not clipped.size:  # a missing cell makes the extremes NaN
                continue
            self._clipped.add(name)
            self._report.loss(
                "clipped",
                f"{self._subject} {name}: at full scale (±{text}); the true value is beyond it",
                count=clipped.size,
                line=int(lines[clipped[0]]),
                subject=f"{self._subject} {name}",
            )

    def _stuck(self, values: Sequence[NDArray[Any]], lines: NDArray[np.int64]) -> None:
        """Runs of at least STALE_ROWS equal readings of all axes, also across blocks."""
        n = len(lines)
        same = np.ones(n, dtype=bool)
        for i, v in enumerate(values):
            same[1:] &= v[1:] == v[:-1]
            same[0] &= self._tail is not None and bool(v[0] == self._tail[i])
            if not same.any():
                break
        self._tail = np.array([v[-1] for v in values], dtype=np.float64)
        if not same.any():
            return
        edges = np.flatnonzero(np.diff(np.concatenate(([False], same, [False])).astype(np.int8)))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            if end - start < STALE_ROWS - 1:
                continue
            self._report.loss(
                "stale_repeat",
                f"{self._subject}: the same reading {end - start + 1} times running: sensor did not answer",
                count=int(end - start),
                line=int(lines[start]),
                subject=self._subject,
            )
