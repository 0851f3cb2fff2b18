"""A lane of states: only changes are logged, and it ends with the recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from .. import style
from ..canvas import Canvas, Times
from ..text import printable


class Lane:
    """States over time on one entity.

    Parameters
    ----------
    canvas : Canvas
        Where to draw.
    path : str
        Entity.
    colors : mapping of str to str, optional
        Colour by state, ``#RRGGBB``; a state that is not named gets one by the viewer.
    hidden : sequence of str
        States that are drawn without a bar.
    """

    def __init__(
        self,
        canvas: Canvas,
        path: str,
        colors: Mapping[str, str] | None = None,
        hidden: Sequence[str] = (),
    ) -> None:
        self.canvas, self.path = canvas, path
        self._last: str | None = None
        if colors:
            names = [printable(n) for n in colors]
            canvas.static(
                path,
                rr.StateConfiguration(
                    values=names,
                    labels=names,
                    colors=[(*style.rgb(c), 255) for c in colors.values()],
                    visible=[n not in hidden for n in colors],
                ),
            )

    def add(self, t_ns: Times, codes: np.ndarray, names: Sequence[str]) -> None:
        """Append states.

        Parameters
        ----------
        t_ns : ndarray of int64, shape (n,)
            Times.
        codes : ndarray of int, shape (n,)
            Places in ``names``.
        names : sequence of str
            States; the empty one is a gap.
        """
        if not len(t_ns):
            return
        change = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
        if names[int(codes[0])] == self._last:
            change = change[1:]
        self._last = names[int(codes[-1])]
        self.canvas.states(self.path, t_ns[change], [names[int(c)] for c in codes[change]])

    def end(self) -> None:
        """Close the last state at the end of the recording."""
        if self._last:
            span = self.canvas.span()[1:]
            self.canvas.states(self.path, span, [""] * span.size)
