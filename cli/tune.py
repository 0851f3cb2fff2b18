"""``marcha tune``: thresholds that fit walks of known length."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from .console import (
    Heading,
    Outcome,
    TextTable,
    progress,
)
from .options import (
    DEFAULT,
    Common,
    Paths,
    Shown,
    Strings,
    settings,
)


def tune(
    paths: Paths,
    /,
    *,
    estimator: Annotated[str, Parameter(name=("--estimator", "-e"))],
    param: Annotated[Strings, Parameter(name=("--param", "-p"))],
    method: Annotated[Literal["grid", "coordinate"], Shown] = "grid",
    inputs: Annotated[Strings, Parameter(name="--input")] = (),
    length: Annotated[float | None, Parameter(name="--length-m")] = None,
    closed: Annotated[bool | None, Parameter(name="--closed", negative="--open")] = None,
    common: Common = DEFAULT,
) -> Outcome:
    """Search the thresholds that fit walks of known length best.

    Replays the recordings with many values and minimises the mean of the
    end error and the distance error, both in percent of the length. One walk
    is little to learn from: check what comes out on another.

    Parameters
    ----------
    paths : Path
        Recordings of walks.
    estimator : str
        Estimator to tune: NAME or NAME[key=value,…]; the parameters in brackets are held.
    param : str
        What to search: key=LOW:HIGH, key=LOW:HIGH:COUNT or key=A,B,C; may be repeated.
    method : str
        grid tries every combination, coordinate one parameter after the other.
    inputs : str
        Topic to attach to; may be repeated. Without it, every channel of the estimator's kind.
    length : float
        Length of every walk in metres, in place of what the recordings say.
    closed : bool
        Whether every walk ends where it began, in place of what the recordings say.
    """
    from .. import recording
    from .. import replay as rp

    with progress("tune", common) as report:
        tuned = rp.tune(
            [recording.open(path) for path in paths],
            estimator,
            settings(param, "--param"),
            method=method,
            inputs=list(inputs) or None,
            length_m=length,
            closed=closed,
            progress=report,
        )
    table = tuned.table.sort("objective", maintain_order=True)
    searched = list(tuned.plateau)
    figures = [c for c in table.columns if c not in searched]
    document = {
        "estimator": tuned.estimator,
        "params": tuned.params,
        "objective_percent": tuned.objective,
        "default_objective_percent": tuned.default_objective,
        "plateau": tuned.plateau,
        "warnings": list(tuned.warnings),
        "points": table.to_dicts(),
    }
    best = ",".join(f"{key}={value}" for key, value in tuned.params.items())
    lines: list[Heading | TextTable] = [
        TextTable([*searched, *(f">{c}" for c in figures)], table.head(20).rows()),
        *([Heading(f"… and {table.height - 20} more (--json has all)")] if table.height > 20 else []),
        Heading(""),
        Heading(
            f"best: {tuned.objective:.4g} %; without: {tuned.default_objective:.4g} %; as good: "
            + "; ".join(f"{k} {', '.join(map(str, v))}" for k, v in tuned.plateau.items())
        ),
        *(Heading(f"beware: {warning}") for warning in tuned.warnings),
        Heading(f"marcha replay … -e '{tuned.estimator}[{best}]'"),
    ]
    return Outcome(document, lines)
