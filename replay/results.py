"""What a replay gives: one result a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from ..recording.errors import Finding


@dataclass
class Run:
    """What came of one estimator on one set of channels.

    Attributes
    ----------
    run : str
        Id.
    estimator, version, input : str
        Name, distribution and version, topic of the first input.
    inputs : dict of str to tuple of str
        Topics by the name of the input.
    params : dict
        Every parameter.
    samples : int
        Rows fed.
    loop_s : float
        Seconds spent in the estimator.
    segments : int
        Stretches between restarts (gap policy reset).
    outputs : dict of str to str
        Topic of every output.
    findings : list of Finding
        What the user must know.
    fatal : bool
        Whether the results must not be used; no metrics then.
    metrics : dict of str to float
        See :mod:`marcha.replay.metrics`.
    alignment : str
        How the track was laid on the reference for them; empty without a reference.
    tables : dict of str to polars.DataFrame
        Results by output (``t_ns``, ``t_log_ns``, columns); empty where they were not kept.
    annotations : polars.DataFrame
        Stances and steps; empty where tables were not kept and a file has them.
    lineage : dict of str to str
        What the recording's metadata record ``run/<id>`` says.
    """

    run: str
    estimator: str
    version: str
    input: str
    inputs: dict[str, tuple[str, ...]]
    params: dict[str, Any]
    samples: int
    loop_s: float
    segments: int
    outputs: dict[str, str]
    findings: list[Finding]
    fatal: bool
    metrics: dict[str, float] = field(default_factory=dict)
    alignment: str = ""
    tables: dict[str, pl.DataFrame] = field(default_factory=dict)
    annotations: pl.DataFrame = field(default_factory=pl.DataFrame)
    lineage: dict[str, str] = field(default_factory=dict)


@dataclass
class ReplayResult:
    """What came of a replay.

    Attributes
    ----------
    output : Path or None
        Recording that was written.
    runs : list of Run
        In the order asked for.
    """

    output: Path | None
    runs: list[Run]
