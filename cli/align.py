"""``marcha align``: one clock for a recording of inertial and optical sources."""

from __future__ import annotations

from pathlib import Path

from .console import Heading, Outcome
from .options import DEFAULT, Common, Force, RecordingOutput


def align(
    recording: Path,
    /,
    *,
    output: RecordingOutput,
    segment: str,
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
        Segment whose sensor and markers, or orientation, are compared.
    force : bool
        Replace an existing recording.
    """
    import msgspec

    from ..ingest.align import align as run

    fit = run(recording, output, segment, overwrite=force)
    summary = (
        f"offset {fit.offset_s:.6f} s ± {fit.offset_sd_s:.6f}, drift {fit.drift_ppm:.2f} ppm ± {fit.drift_sd_ppm:.2f}, "
        f"r = {fit.correlation:.4f} over {fit.overlap_s:.1f} s"
    )
    return Outcome({"output": str(output), **msgspec.to_builtins(fit)}, [Heading(f"{output}: {summary}")])
