"""``marcha replay`` and ``marcha evaluate``: a recording through estimators, and how good the results are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from .console import (
    Heading,
    Outcome,
    TextTable,
    columns_of,
    progress,
)
from .contents import finding_entry, say_losses
from .errors import DEFECTS, DONE, THRESHOLD
from .options import (
    DEFAULT,
    Common,
    Force,
    MaybeRecordingOutput,
    Paths,
    Shown,
    Strings,
    instant,
    limits,
    settings,
    spans,
)


def replay(
    path: Path,
    /,
    *,
    estimator: Annotated[Strings, Parameter(name=("--estimator", "-e"))],
    param: Annotated[Strings, Parameter(name=("--param", "-p"))] = (),
    inputs: Annotated[Strings, Parameter(name="--input")] = (),
    speed: Annotated[str, Shown] = "max",
    start: Annotated[str | None, Parameter(name="--from")] = None,
    end: Annotated[str | None, Parameter(name="--to")] = None,
    gap: Annotated[Literal["bridge", "reset", "stop"], Shown] = "bridge",
    calibration: Annotated[Paths, Parameter(name="--calibration")] = (),
    withhold: Annotated[Strings, Parameter(name="--withhold")] = (),
    survey: Path | None = None,
    output: MaybeRecordingOutput = None,
    rrd: Path | None = None,
    show: bool = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Feed a recording to estimators as if it were live.

    Results are recorded beside the raw channels. Exit code 3 says that the
    results of at least one run must not be used; its findings say why.

    Parameters
    ----------
    path : Path
        The recording.
    estimator : str
        Estimator to run: NAME, NAME[key=value,…], LABEL=NAME[…], or a chain A+B; may be repeated. All run in
        one pass.
    param : str
        key=value for every estimator that has this parameter; may be repeated.
    inputs : str
        ROLE=TOPIC, or a topic to attach to; may be repeated. Without it, every channel of the estimator's kind,
        one run each.
    speed : str
        max, or a factor of real time such as 1 or 2.5.
    start : str
        Start here: 12.5, 12.5s, 1m, 500ms after the recording's start, or @NANOSECONDS of its clock.
    end : str
        Stop before here; written like --from.
    gap : str
        What a pause of the input does: bridge it, reset the estimator after it, or stop before it.
    calibration : Path
        File of `marcha calibrate`, handed to the estimators; may be repeated.
    withhold : str
        TOPIC=START:LENGTH, an artificial loss of a signal: messages that no estimator is given, such as
        /phone/gnss=120:60s (and with it the receiver's velocity); may be repeated. The metrics say how far off
        the track is at its end.
    survey : Path
        Recording of fixes along the same route at another time; tracks are measured by their distance to it.
    output : Path
        Recording to write: everything that was in the input, and the estimates.
    rrd : Path
        Rerun file to write.
    show : bool
        Open the Rerun viewer and show the replay while it runs.
    force : bool
        Replace existing outputs.
    """
    from .. import recording
    from .. import replay as rp

    rec = recording.open(path)
    sinks: list[Any] = []
    if rrd is not None or show:
        from .. import viz

        sinks.append(viz.LiveSink(path=rrd, show=show, overwrite=force))
    with progress("replay", common, before="replay: estimators are compiled (once on a machine)") as report:
        result = rp.replay(
            rec,
            list(estimator),
            params=settings(param, "--param"),
            inputs=list(inputs) or None,
            speed=speed,
            start_ns=instant(start, rec, "--from"),
            end_ns=instant(end, rec, "--to"),
            out=output,
            overwrite=force,
            sinks=sinks,
            gap=gap,
            calibrations=[rp.load_calibration(c) for c in calibration],
            withhold=spans(withhold, rec, "--withhold"),
            survey=recording.open(survey) if survey else None,
            keep_tables=output is None,  # with a file, memory stays bounded and metrics come from there
            progress=report,
        )
    runs = [
        {
            "run": run.run,
            "estimator": run.estimator,
            "input": run.input,
            "params": run.params,
            "samples": run.samples,
            "fatal": run.fatal,
            "loop_s": run.loop_s,
            "outputs": list(run.outputs.values()),
            "metrics": run.metrics,
            "alignment": run.alignment,
            "findings": [finding_entry(f) for f in run.findings],
        }
        for run in result.runs
    ]
    document = {
        "output": str(output) if output else None,
        "rrd": str(rrd) if rrd else None,
        "runs": runs,
    }
    lines: list[Heading | TextTable] = [
        TextTable(
            ["run", "estimator", "input", ">samples", ">loop [s]"],
            [[r["run"], r["estimator"], r["input"], r["samples"], r["loop_s"]] for r in runs],
        ),
        Heading(""),
        columns_of((r["run"], _figures(r)) for r in runs),
        *_remarks(runs),
        *(Heading(f"wrote {p}") for p in (output, rrd) if p),
    ]
    say_losses(rec)
    return Outcome(document, lines, DEFECTS if any(r["fatal"] for r in runs) else DONE)


def _figures(run: dict[str, Any]) -> dict[str, Any]:
    return run["metrics"] | ({"alignment": run["alignment"]} if run["alignment"] else {})


def _remarks(runs: list[dict[str, Any]]) -> list[Heading]:
    """Return what the user must know; what holds for every run of an input is said once."""
    runs_of: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for run in runs:
        for finding in run["findings"]:
            runs_of.setdefault((finding["kind"], finding["detail"]), []).append(run)
    lines = []
    for (kind, detail), those in runs_of.items():
        inputs = list(dict.fromkeys(run["input"] for run in those))
        all_of_them = len(those) > 1 and len(those) == sum(run["input"] in inputs for run in runs)
        whom = ", ".join(inputs if all_of_them else [run["run"] for run in those])
        lines.append(Heading(f"{whom}: {kind}: {detail.removeprefix(f'{whom}: ')}"))
    return lines


def evaluate(
    path: Path,
    /,
    *,
    maximum: Annotated[Strings, Parameter(name="--max")] = (),
    minimum: Annotated[Strings, Parameter(name="--min")] = (),
    run: Annotated[Strings, Parameter(name="--run")] = (),
    alignment: Literal["none", "origin", "origin-yaw", "se2", "sim2", "se3"] | None = None,
    reference: str | None = None,
    survey: Path | None = None,
    truth: Strings = (),
    by: str | None = None,
    common: Common = DEFAULT,
) -> Outcome:
    """Measure the estimates of a replayed recording.

    Parameters
    ----------
    path : Path
        A recording with estimates (marcha replay … -o).
    maximum : str
        metric=limit that no run may exceed, such as rmse_deg=5; may be repeated. A miss gives exit code 4.
    minimum : str
        metric=limit that every run must reach; may be repeated.
    run : str
        Id of a run to measure; may be repeated. All without it.
    alignment : str
        How a track is laid on the reference: as it is, first position, also first heading, least squares
        over turn about the vertical and shift, also over a scale, or over all rotations and shift. Without
        it none where both lie on one floor plan, else se3.
    reference : str
        Topic of a reference, where several would fit.
    survey : Path
        Recording of fixes along the same route at another time; tracks are measured by their distance to it.
    truth : str
        What is known of the walk beside what the recording says: closed=true, length_m=22.1, steps=63; may be
        repeated.
    by : str
        Tier of annotations (turn, terrain …): every figure by its labels, and of what lies between.
    """
    import msgspec

    from .. import recording
    from .. import replay as rp

    bounds = limits(maximum, "--max"), limits(minimum, "--min")
    rec = recording.open(path)
    evaluation = rp.evaluate(
        rec,
        runs=list(run) or None,
        alignment=alignment,
        reference=reference,
        truth={k: str(v).lower() for k, v in settings(truth, "--truth").items()},
        by=by,
        survey=recording.open(survey) if survey else None,
    )
    say_losses(rec)
    missed = rp.check_thresholds(evaluation, *bounds)
    runs = msgspec.to_builtins(evaluation.runs)
    figures = [
        (
            r["run"],
            {
                **r["metrics"],
                **(_comparison(r) if r["alignment"] else {}),
            },
        )
        for r in runs
    ]
    lines: list[Heading | TextTable] = [columns_of(figures)]
    lines += [Heading(f"{r['run']}: {r['note']}") for r in runs if r["note"]]
    for r in runs:
        for joint in r["cycles"]:
            lines += _over_the_cycle(r["run"], joint)
    if by is not None:
        for r in runs:
            lines += [Heading(f"\n{r['run']} by {by}"), columns_of(_by_label(r))]
    else:
        for tier, label in dict.fromkeys((i["tier"], i["label"]) for r in runs for i in r["intervals"]):
            lines += [Heading(f"\n{tier}: {label}"), columns_of(_within(runs, tier, label))]
    lines += [Heading(_miss(m)) for m in missed]
    return Outcome(
        {"runs": runs, "missed": [msgspec.to_builtins(m) for m in missed]},
        lines,
        THRESHOLD if missed else DONE,
    )


def _comparison(run: dict[str, Any]) -> dict[str, Any]:
    """Return what was compared with the reference, and how."""
    return {
        "matched (samples)": run["matched"],
        "dropped (samples)": run["dropped"],
        "alignment": run["alignment"],
    }


def _by_label(run: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return one column a label of the tier, and one of what lies between."""
    from ..replay.metrics import BETWEEN

    return [
        (
            BETWEEN if g["label"] is None else g["label"] or "(no label)",
            {
                "intervals": g["intervals"],
                "duration_s": g["duration_s"],
                **({"matched (samples)": g["matched"]} if run["alignment"] else {}),
                **g["metrics"],
            },
        )
        for g in run["groups"]
    ]


def _over_the_cycle(run: str, joint: dict[str, Any]) -> list[Heading | TextTable]:
    """Return a joint's angle at every tenth of the gait cycle: mean and standard deviation over the cycles."""
    parts = ("reference", "estimate", "error")
    rows = [
        [percent, *(joint[f"{part}_{what}"][percent] for part in parts for what in ("mean", "sd"))]
        for percent in range(0, 101, 10)
    ]
    head = f"\n{run}: {joint['joint']} over {joint['count']} gait cycles (from {joint['starts']}), °"
    return [
        Heading(head),
        TextTable([">cycle [%]", *(f">{p} {w}" for p in parts for w in ("mean", "sd"))], rows),
    ]


def _within(runs: list[dict[str, Any]], tier: str, label: str) -> list[tuple[str, dict[str, Any]]]:
    """Return one column a run and interval of this name; several of one name are numbered."""
    rows = []
    for run in runs:
        same = [i for i in run["intervals"] if (i["tier"], i["label"]) == (tier, label)]
        for number, interval in enumerate(same, 1):
            name = run["run"] if len(same) == 1 else f"{run['run']} ({number})"
            rows.append((name, interval["metrics"]))
    return rows


def _miss(missed: Any) -> str:
    sign = "above" if missed.kind == "max" else "below"
    has = "has no value" if missed.value is None else f"{missed.value:.6g} is {sign} {missed.bound:g}"
    return f"missed: {missed.run}: {missed.metric}: {has}"
