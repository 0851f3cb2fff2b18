"""``marcha simulate``: raw logs of walks with known truth."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from .console import Heading, Outcome
from .options import (
    DEFAULT,
    Common,
    Force,
    Output,
    Shown,
    Strings,
    settings,
)


def simulate(
    scenario: str,
    /,
    *,
    output: Output,
    option: Annotated[Strings, Parameter(name="--set")] = (),
    seed: Annotated[int, Shown] = 0,
    format: Annotated[
        Literal["text", "packets", "android-text", "phyphox", "sensor-logger", "three-tables"], Shown
    ] = "text",
    name: str | None = None,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Write raw logs of a simulated walk with known truth.

    Parameters
    ----------
    scenario : str
        rectangle, straight, figure-eight, stairs, ramp, lift or still; of legs: walking, sit-to-stand or squats;
        of a phone: phone-10m, phone-50m, phone-100m, phone-turns, phone-loop, phone-city, phone-floors,
        phone-rest, phone-handled; of a phone among anchors: floor-walk, floor-loop, floor-points,
        floor-survey.
    output : Path
        Folder for the raw logs and the truth beside them.
    option : str
        key=value of the scenario or the sensors; may be repeated.
    seed : int
        Seed of every random number: the same seed gives the same files.
    format : str
        What the device writes: serial text or binary packets; of a phone android-text, phyphox or
        sensor-logger; of a floor three-tables.
    name : str
        Middle of the file names; SCENARIO-SEED without it.
    force : bool
        Replace files of the same names.
    """
    from ..ingest.simulate import simulate as run
    from ..recording.errors import UsageError

    options = settings(option, "--set")
    for taken in ("seed", "name", "format", "overwrite"):
        if taken in options:
            raise UsageError(f"--set {taken}: has an option of its own; see marcha simulate --help")
    made = run(scenario, output, seed=seed, name=name, format=format, overwrite=force, **options)
    document = {
        "scenario": scenario,
        "output": str(output),
        "files": [str(path) for path in made.paths],
        "truth": [str(path) for path in made.truth],
        "rows": made.rows,
        "closed": made.closed,
        "length_m": made.length_m,
    }
    lines = [Heading(f"wrote {path}") for path in (*made.paths, *made.truth)]
    closed = "closed" if made.closed else "open"
    walk = f", {closed} walk of {made.length_m:.2f} m" if made.length_m else ""
    lines.append(Heading(f"{made.rows} rows{walk}"))
    return Outcome(document, lines)
