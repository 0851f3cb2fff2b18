"""A gyroscope that stops below its nominal full scale: its swings pile up at one height and have flat tops.

Some devices stop at a ceiling of their own, blurred by their filter and noise, so that no two extreme readings
are equal and none reaches the nominal range. What gives it away is the half-waves (readings between two changes of
sign): where at least :data:`LEAST` of them reach within 3 % of the highest reading, more than stop between 3 and 15 %
below it, and they stay there longer than a rounded top would. Of a parabola's time above 85 % of its height √(3/15) =
0.45 lie above 97 %; ceilings of real devices have 0.57 to 0.86.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST = 5
TOP, SHOULDER = 0.97, 0.85
FLAT = 0.52
LEAST_RATE = 3.0
"""rad/s: no gyroscope has a ceiling below 170 °/s."""
KEPT = 4096
"""Half-waves of an axis that are remembered, the highest ones."""


class CeilingSearch:
    """Watches one axis while blocks stream by.

    Samples of the half-waves are kept, sorted and cut to what lies above :data:`SHOULDER` of the highest reading of
    their sign: bounded by the number of half-waves that come near it.
    """

    def __init__(self) -> None:
        self._half: dict[bool, list[tuple[int, FloatArray]]] = {True: [], False: []}
        self._highest = {True: 0.0, False: 0.0}
        self._open: tuple[bool, int, FloatArray] | None = None

    def feed(self, values: FloatArray, lines: IntArray) -> None:
        """Look at a block in rad/s, with each row's line."""
        finite = np.isfinite(values)
        if not finite.all():
            values, lines = values[finite], lines[finite]
        if not values.size:
            return
        negative = np.signbit(values)
        starts = np.concatenate(([0], np.flatnonzero(np.diff(negative)) + 1, [len(values)]))
        heights = np.abs(values)
        tallest = np.maximum.reduceat(heights, starts[:-1])
        # Most half-waves of a walk are low: only those that may count, and both edges, are looked at one by one.
        least = np.where(negative[starts[:-1]], self._highest[False], self._highest[True])
        high = tallest >= np.maximum(LEAST_RATE, SHOULDER * least)
        high[0] = high[-1] = True
        for k in np.flatnonzero(high).tolist():
            height = float(tallest[k])
            positive = not negative[starts[k]]
            at_edge = k == 0 or k == len(tallest) - 1
            if not at_edge and height < max(LEAST_RATE, SHOULDER * self._highest[positive]):
                continue
            piece = heights[starts[k] : starts[k + 1]]
            line = int(lines[starts[k] + int(piece.argmax())])
            if k == 0 and self._open is not None and self._open[0] == positive:
                before = self._open
                line = before[1] if before[2].max(initial=0.0) >= height else line
                piece = np.concatenate((before[2], piece))
            elif self._open is not None:
                self._close(*self._open)
            self._open = None
            if k == len(tallest) - 1:
                self._open = (positive, line, piece[piece >= 0.5 * piece.max()])
            else:
                self._close(positive, line, piece)

    def _close(self, positive: bool, line: int, piece: FloatArray) -> None:
        height = float(piece.max(initial=0.0))
        self._highest[positive] = max(self._highest[positive], height)
        if height < max(LEAST_RATE, SHOULDER * self._highest[positive]):
            return
        waves = self._half[positive]
        waves.append((line, piece[piece >= SHOULDER * self._highest[positive]]))
        if len(waves) > KEPT:
            waves.sort(key=lambda w: -float(w[1].max(initial=0.0)))
            del waves[KEPT // 2 :]

    def ceilings(self) -> list[tuple[float, int, int]]:
        """Return (ceiling in rad/s with its sign, half-waves that reach it, line of the first) for each sign."""
        if self._open is not None:
            self._close(*self._open)
            self._open = None
        result = []
        for positive, waves in self._half.items():
            highest = self._highest[positive]
            tops = [w for w in waves if w[1].max(initial=0.0) >= TOP * highest]
            near = sum(SHOULDER * highest <= w[1].max(initial=0.0) < TOP * highest for w in waves)
            if highest < LEAST_RATE or len(tops) < LEAST or len(tops) <= near:
                continue
            above = sum(int((w[1] >= TOP * highest).sum()) for w in tops)
            broad = sum(int((w[1] >= SHOULDER * highest).sum()) for w in tops)
            if above >= FLAT * broad:
                result.append((highest if positive else -highest, len(tops), min(w[0] for w in tops)))
        return result
