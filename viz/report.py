"""The report beside the pictures: metrics, parameters, findings and provenance as Markdown."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence

from ..recording import Recording
from ..recording import open as open_recording
from ..recording.errors import MarchaError
from ..recording.names import is_estimate
from ..replay import Evaluation, ReplayResult, RunEvaluation, evaluate
from .text import printable

LONGEST = 120
"""Characters of a cell; longer values (JSON, hashes) are cut, the recording has them whole."""

LINEAGE = ("estimator", "version", "input", "samples", "loop_s")


def measured(rec: Recording) -> Evaluation | str:
    """Return the metrics of a recording's runs, or why there are none."""
    if not any(n.startswith("run/") for n in rec.metadata) and not any(map(is_estimate, rec.channels)):
        return ""
    try:
        return evaluate(rec)
    except MarchaError as error:
        return printable(error)


def report(rec: Recording, metrics: Evaluation | str | None = None) -> str:
    """Return what a recording and its runs are, as Markdown.

    Parameters
    ----------
    rec : Recording
        Raw, or with estimates (their metrics are measured, see :func:`marcha.replay.evaluate`).
    metrics : Evaluation or str, optional
        What :func:`measured` returned; it is asked without it.
    """
    if metrics is None:
        metrics = measured(rec)
    runs = {n.removeprefix("run/"): m for n, m in rec.metadata.items() if n.startswith("run/")}
    parts = [f"# {printable(rec.path.name)}", "", f"{rec.duration_s:.2f} s, {len(rec.channels)} channels", ""]
    parts += verdicts(runs)
    if isinstance(metrics, str):
        parts += ["## Metrics", "", f"Not measured: {metrics}", ""] if metrics else []
    else:
        parts += _metrics(metrics.runs)
    if runs:
        parts += _parameters(runs)
        parts += _findings(
            (f"run {run}", kind, count, detail)
            for run, lineage in runs.items()
            for kind, count, detail in json.loads(lineage.get("findings", "[]"))
        )
    parts += _findings(("reading", f.kind, f.count, f.detail) for f in rec.findings)
    rows = [[t, c.schema, f"{c.count}"] for t, c in rec.channels.items()]
    parts += ["## Channels", "", *_table(["topic", "message", "count"], rows)]
    for name, record in rec.metadata.items():
        if not name.startswith("run/"):
            parts += [
                f"## {printable(name)}",
                "",
                *_table(["what", "value"], [[k, v] for k, v in record.items()]),
            ]
    return "\n".join(parts)


def verdicts(runs: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return what must be known before any number is read: runs whose results must not be used, and doubts.

    Parameters
    ----------
    runs : mapping
        Lineage by run.
    """
    parts: list[str] = []
    for run, lineage in runs.items():
        kinds = list(dict.fromkeys(kind for kind, _, _ in json.loads(lineage.get("findings", "[]"))))
        if lineage.get("fatal") == "true":
            parts.append(f"- **{printable(run)}: results must not be used** ({', '.join(kinds)})")
        elif kinds:
            parts.append(f"- {printable(run)}: {', '.join(kinds)}")
    return ["## Verdict", "", *parts, "", "Details: the findings in the report.", ""] if parts else []


def replay_report(result: ReplayResult) -> str:
    """Return what came of a replay, as Markdown: of its recording where one was written, else of its runs."""
    if result.output is not None:
        return report(open_recording(result.output))
    names = list(dict.fromkeys(m for r in result.runs for m in r.metrics))
    rows = [[m, *(_number(r.metrics.get(m)) for r in result.runs)] for m in names]
    return "\n".join(
        [
            "# Replay",
            "",
            "## Metrics",
            "",
            *_table(["metric", *(r.run for r in result.runs)], rows),
            *_parameters({r.run: r.lineage for r in result.runs}),
            *_findings((f"run {r.run}", f.kind, f.count, f.detail) for r in result.runs for f in r.findings),
        ]
    )


def _metrics(runs: Sequence[RunEvaluation]) -> list[str]:
    names = list(dict.fromkeys(m for r in runs for m in r.metrics))
    rows = [[m, *(_number(r.metrics.get(m)) for r in runs)] for m in names]
    parts = ["## Metrics", "", *_table(["metric", *(r.run for r in runs)], rows)]
    for run in runs:
        if run.alignment:
            parts += [
                f"{run.run}: {run.matched} samples compared with the reference, {run.dropped} left out, "
                f"alignment {run.alignment}.",
                "",
            ]
        if run.note:
            parts += [f"{run.run}: {printable(run.note)}", ""]
    return parts


def _parameters(runs: Mapping[str, Mapping[str, str]]) -> list[str]:
    by_run = {run: {k: v for k, v in m.items() if k in LINEAGE} for run, m in runs.items()}
    for run, lineage in runs.items():
        params = lineage.get("params", "")
        values = json.loads(params) if params.startswith("{") else {}
        values |= {k.removeprefix("param."): v for k, v in lineage.items() if k.startswith("param.")}
        by_run[run] |= {k: str(v) for k, v in values.items()}
    names = list(dict.fromkeys(k for values in by_run.values() for k in values))
    rows = [[n, *(values.get(n, "") for values in by_run.values())] for n in names]
    return ["## Runs and their parameters", "", *_table(["", *by_run], rows)]


def _findings(rows: Iterable[tuple[str, str, int, str]]) -> list[str]:
    entries = [[where, kind, f"{count}", detail] for where, kind, count, detail in rows]
    return ["## Findings", "", *_table(["where", "kind", "count", "detail"], entries)] if entries else []


def _number(value: float | None) -> str:
    return "" if value is None else "NaN" if math.isnan(value) else f"{value:.4g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(_cell(c) for c in line)} |" for line in lines), ""]


def _cell(text: str) -> str:
    text = printable(" ".join(str(text).split())).replace("|", "\\|")
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
