"""``marcha demo``: the whole way on simulated walks, from the device's text to a page of results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from .console import (
    Heading,
    Outcome,
    TextTable,
    columns_of,
    number,
)
from .contents import finding_entry
from .options import (
    DEFAULT,
    Common,
    Force,
    Shown,
)

if TYPE_CHECKING:
    from ..recording import Recording

WALKS = (
    ("rectangle", "rectangle", "3333"),
    ("rectangle-clipped", "rectangle", "0000"),
    ("stairs", "stairs", "3333"),
)
"""Name, scenario and full-scale codes: one clean walk, one whose sensors clip, one that climbs."""

ESTIMATORS = ("foot.naive", "foot.9iez", "foot.15iez-zaru")
"""Uncorrected, corrected, with sensor biases: a fresh machine compiles each for some seconds."""

SENSOR = "/foot/imu2"
"""The sensor whose scale is right; the other one reads 2 % low at rest, as the real device's does."""

FIGURES = (
    "closure_percent",
    "path_error_percent",
    "height_error_m",
    "ate_rmse_m",
    "position_error_end_m",
    "heading_rmse_deg",
    "within95_position_percent",
    "run_time_s",
)
"""Metrics that the page shows; ``marcha evaluate`` gives all of them."""


def demo(
    *,
    output: Annotated[Path, Parameter(name=("--output", "-o"), show_default=True)] = Path("demo"),
    show: bool = False,
    seed: Annotated[int, Shown] = 1,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Simulate, convert, replay, evaluate and export three walks.

    Parameters
    ----------
    output : Path
        Folder to write: raw logs, recordings, walk.rrd, tracks.png, exports, summary.md.
    show : bool
        Open the result in the Rerun viewer (the environment variable SHOW=1 does the same).
    seed : int
        Seed of the simulation.
    force : bool
        Replace an earlier demo.
    """
    import os

    from .. import recording, viz
    from ..export.folder import whole_folder

    with whole_folder(output, overwrite=force, marker="summary.md") as folder:
        walks = [_walk(folder, *walk, seed=seed, common=common) for walk in WALKS]
        recs = [recording.open(folder / w["recording"]) for w in walks]
        _hand_on(folder, recs[0])
        viz.save_figure(recs, folder / "tracks.png")
        (folder / "summary.md").write_text(_summary(walks), encoding="utf-8")
    document = {
        "output": str(output),
        "recordings": [str(output / w["recording"]) for w in walks],
        "rrd": str(output / "walk.rrd"),
        "figure": str(output / "tracks.png"),
        "summary": str(output / "summary.md"),
        "exports": [str(output / "handed-on.mcap"), str(output / "csv")],
        "walks": walks,
    }
    lines: list[Any] = []
    for walk in walks:
        lines += [
            Heading(f"{walk['name']}:"),
            _table(walk),
            Heading(""),
        ]
    lines.append(Heading(f"wrote {output}: read summary.md, look at tracks.png, open walk.rrd"))
    if show or os.environ.get("SHOW", "") not in ("", "0"):
        viz.show([recording.open(output / walks[0]["recording"])])
    return Outcome(document, lines)


def _walk(
    folder: Path, name: str, scenario: str, config: str, *, seed: int, common: Common
) -> dict[str, Any]:
    """Take one walk from its raw text to a recording with estimates; return what is to be said about it."""
    from .. import algorithms, ingest, recording
    from .. import replay as rp
    from ..ingest.simulate import simulate

    say = (lambda text: None) if common.quiet else (lambda text: print(f"{name}: {text}", file=sys.stderr))
    say("simulate")
    raw = simulate(scenario, folder / "raw", seed=seed, name=name, config=config)
    say(f"convert {raw.rows} rows")
    converted = ingest.convert(raw.paths, folder / f"{name}.raw.mcap")
    there = [e for e in ESTIMATORS if e in algorithms.available()]
    say(f"replay through {', '.join(there)}")
    target = folder / f"{name}.mcap"
    rp.replay(recording.open(folder / f"{name}.raw.mcap"), there, inputs=[SENSOR], out=target)
    (folder / f"{name}.raw.mcap").unlink()
    evaluation = rp.evaluate(recording.open(target), intervals=False)
    return {
        "name": name,
        "scenario": scenario,
        "length_m": raw.length_m,
        "log": f"raw/{raw.paths[0].name}",
        "recording": target.name,
        "rows_read": converted.report.rows_read,
        "findings": [finding_entry(f) for f in converted.report.findings],
        "runs": [
            {
                "run": r.run,
                "estimator": r.estimator,
                "alignment": r.alignment,
                "note": r.note,
                "metrics": r.metrics,
            }
            for r in evaluation.runs
        ],
    }


def _table(walk: dict[str, Any]) -> TextTable:
    return columns_of(
        (r["estimator"], {m: r["metrics"][m] for m in FIGURES if m in r["metrics"]}) for r in walk["runs"]
    )


def _hand_on(folder: Path, rec: Recording) -> None:
    """Write the first walk in the forms that other programs read."""
    from .. import viz
    from ..export import export

    viz.write_rrd([rec], folder / "walk.rrd")
    export(rec, "mcap", folder / "handed-on.mcap")
    export(rec, "csv", folder / "csv")


def _summary(walks: list[dict[str, Any]]) -> str:
    """Return the page of results, as Markdown."""
    page = [
        "# marcha demo",
        "",
        "Three simulated walks with a shoe-mounted MPU-6050: raw device text, one recording each, replayed",
        f"sample by sample through the estimators ({SENSOR}), measured against the simulator's truth.",
        "",
        "![Tracks from above and height over time](tracks.png)",
        "",
    ]
    for walk in walks:
        findings = (
            "; ".join(f"{f['kind']} {f['count']} ({f['detail']})" for f in walk["findings"]) or "nothing"
        )
        names = [m for m in FIGURES if any(m in r["metrics"] for r in walk["runs"])]
        page += [
            f"## {walk['name']}",
            "",
            f"{walk['log']}: {walk['rows_read']} rows, {walk['length_m']:.1f} m. The import found: {findings}.",
            "",
            "| metric | " + " | ".join(r["estimator"] for r in walk["runs"]) + " |",
            "|---|" + "---:|" * len(walk["runs"]),
            *(
                f"| {m} | " + " | ".join(number(r["metrics"].get(m)) for r in walk["runs"]) + " |"
                for m in names
            ),
            "",
            *(f"- {r['estimator']}: {r['note']}" for r in walk["runs"] if r["note"]),
        ]
    page += [
        "## What is in this folder",
        "",
        "| file | what |",
        "|---|---|",
        "| raw/ | the device's text, and the truth beside it |",
        *(
            f"| {w['recording']} | {w['name']}: raw signals, truth, estimates, stance and steps |"
            for w in walks
        ),
        f"| walk.rrd | {walks[0]['name']} for the Rerun viewer: `rerun walk.rrd` |",
        f"| handed-on.mcap | {walks[0]['name']}, annotated, for Foxglove, PlotJuggler, ROS 2 |",
        f"| csv/ | {walks[0]['name']} as tables, with units in channels.json and README.txt |",
        "| tracks.png | the picture above |",
        "",
        f"Look on: `marcha view {walks[0]['recording']}`, `marcha info {walks[0]['recording']}`, "
        f"`marcha evaluate {walks[0]['recording']}`.",
    ]
    return "\n".join(page) + "\n"
