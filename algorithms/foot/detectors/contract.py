"""What a zero-velocity detector is: parameters, a record, statistics of a window and a raw decision."""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np

SKOG = "Skog et al. 2010, settings of the authors' program"
DISSERTATION = "dissertation, section 4.4"


class Detector:
    """Base of the detectors; each is one module of this folder.

    Its module has, beside the subclass, the compiled function ``judge(d, ring, j, lo, hi) -> bool``: it
    writes the statistics of sample ``j``, from the samples ``lo`` to ``hi`` in ``ring``, to
    ``ring[j].statistic`` and returns the raw decision. ``d`` is the detector's own record.

    Attributes
    ----------
    name : str
        As the parameter ``detector`` calls it.
    title, source : str
        One line; author and year.
    Params : type of msgspec.Struct
        Its thresholds; the names are its own among all detectors.
    RECORD : numpy.dtype
        Constants and state, used by ``judge``; one field at least.
    statistics : tuple of str
        Names of the statistics, at most three.
    window_s : float
        Length of the window where ``window_s`` is not given, s.
    cleaning : str
        Cleaning of the raw decisions where the parameter ``cleaning`` says ``own``.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    Params: ClassVar[type[msgspec.Struct]]
    RECORD: ClassVar[np.dtype[Any]]
    statistics: ClassVar[tuple[str, ...]]
    window_s: ClassVar[float] = 0.05
    cleaning: ClassVar[str] = "median"

    @classmethod
    def horizon_s(cls, params: Any) -> float:
        """Return how far beyond its window the decision looks ahead, s; its module then has ``settle``."""
        return 0.0

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the constants from the estimator's parameters into the detector's own record."""
        raise NotImplementedError

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the limit of each statistic; ``<statistic>.min`` for a floor."""
        raise NotImplementedError
