"""``marcha align``: one clock for a recording of inertial and optical sources."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

from .console import Heading, Outcome
from .options import DEFAULT, Common, Force, RecordingOutput, Strings


def align(
    recording: Path,
    /,
    *,
    output: RecordingOutput,
    segment: str | None = None,
    offset: float | None = None,
    drift: float = 0.0,
    event: Strings = (),
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Move the optical clock of a recording to the inertial one.

    Parameters
    ----------
    recording : Path
        Recording of sources on two clocks (marcha convert A B -o REC).
    output : Path
        Recording to write.
    segment : str
        Segment whose rates are compared: its sensor beside its orientation or markers. Without it all that both
        clocks have.
    offset : float
        Inertial minus optical time (s), where it is known; nothing is compared then.
    drift : float
        With it: how much faster the inertial clock runs (ppm).
    event : str
        INERTIAL=OPTICAL: times (s) of what both clocks saw, a stamp of the foot; may be repeated. One gives the
        offset, more the drift too.
    force : bool
        Replace an existing recording.
    """
    import msgspec

    from ..ingest.align import align as run

    fit = run(
        recording,
        output,
        segment,
        offset_s=offset,
        drift_ppm=drift,
        events=[_times(e) for e in event],
        overwrite=force,
    )
    summary = f"{fit.method}: offset {fit.offset_s:.6f} s"
    summary += f" ± {fit.offset_sd_s:.6f}" if isfinite(fit.offset_sd_s) else ""
    summary += f", drift {fit.drift_ppm:.2f} ppm"
    summary += f" ± {fit.drift_sd_ppm:.2f}" if isfinite(fit.drift_sd_ppm) else ""
    if fit.method == "rates":
        summary += f", r = {fit.correlation:.4f} over {fit.overlap_s:.1f} s"
    return Outcome({"output": str(output), **msgspec.to_builtins(fit)}, [Heading(f"{output}: {summary}")])


def _times(text: str) -> tuple[float, float]:
    from ..recording.errors import UsageError

    try:
        imu, optical = (float(part) for part in text.split("="))
    except ValueError:
        raise UsageError(
            f"--event {text}: must be INERTIAL=OPTICAL, two times in s such as 12.34=10.02"
        ) from None
    return imu, optical
