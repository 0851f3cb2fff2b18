"""Leave one recording out: calibrate on all others, locate in it; so radio maps are judged on ways they do not know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..recording.errors import UsageError
from .api import replay
from .calibrations import calibrate

if TYPE_CHECKING:
    from ..recording import Recording
    from .engine import Run


def leave_one_out(
    recordings: Sequence[Recording],
    estimators: Sequence[str],
    *,
    calibration: str = "radio",
    params: Mapping[str, Any] | None = None,
) -> dict[str, list[Run]]:
    """Return the runs in each recording with what the others calibrate.

    Parameters
    ----------
    recordings : sequence of Recording
        With a reference below ``/reference/``, two at least.
    estimators : sequence of str
        As :func:`replay` takes them.
    calibration, params
        What is calibrated, and its parameters (``cell_m`` about 2 for radio maps from walks).

    Returns
    -------
    dict of str to list of Run
        By the recording's path, with metrics.

    Raises
    ------
    UsageError
        Fewer than two recordings, or one that cannot be calibrated from.
    """
    if len(recordings) < 2:
        raise UsageError("leave one out: two recordings at least, so that one is left to calibrate from")
    runs: dict[str, list[Run]] = {}
    for k, rec in enumerate(recordings):
        others = [r for i, r in enumerate(recordings) if i != k]
        runs[str(rec.path)] = list(
            replay(rec, list(estimators), calibrations=calibrate(calibration, others, params)).runs
        )
    return runs
