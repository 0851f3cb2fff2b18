"""``marcha convert``: raw logs to recordings, with a report of every defect."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from .console import (
    Heading,
    Outcome,
    TextTable,
    complain,
    progress,
)
from .contents import channel_table, finding_entry, finding_table
from .errors import (
    DEFECTS,
    DONE,
    FAILED,
    expected,
)
from .options import (
    DEFAULT,
    Common,
    Force,
    RecordingOrFolder,
    Strings,
    settings,
)


def convert(
    *paths: Path,
    output: RecordingOrFolder,
    format: str | None = None,
    mapping: Annotated[Path | None, Parameter(name="--map")] = None,
    option: Annotated[Strings, Parameter(name="--set")] = (),
    truth: Strings = (),
    strict: bool = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Turn raw logs into recordings and report every defect.

    With -o FILE.mcap, all inputs together become one recording. With -o
    FOLDER/ (a trailing slash, or a folder that exists), each input becomes a
    recording of its own name there; an input that is a folder of logs stands
    for each log in it whose format is recognised, the others are named as
    skipped. There, a file that fails does not stop the others; the exit code
    is the worst of all.

    Parameters
    ----------
    paths : Path
        Files, folders or zip archives of raw logs.
    output : str
        Recording to write, or a folder for one recording an input.
    format : str
        Format of the input; found by its content without it (marcha formats lists them). Beside inputs of this
        format one that is surely of another, such as a C3D file, keeps its own.
    mapping : Path
        TOML mapping for the format table: columns, units, time, frames.
    option : str
        key=value of the format (marcha formats lists them); may be repeated.
    truth : str
        What is known of the walk: closed=true, length_m=22.1, steps=63; may be repeated.
    strict : bool
        Fail where something would have to be repaired or dropped.
    force : bool
        Replace existing recordings.
    """
    from ..recording.errors import UsageError

    if not paths:
        raise UsageError("convert: name at least one input")
    options: dict[str, Any] = {
        "format": format,
        "mapping": mapping,
        "options": settings(option, "--set"),
        "truth": settings(truth, "--truth"),
        "strict": strict,
        "overwrite": force,
    }
    if output.endswith(("/", "\\")) or Path(output).is_dir():
        return _each(paths, Path(output), options, common)
    document, lines, code = _one(list(paths), Path(output), options, common)
    return Outcome(document, lines, code)


def _one(
    paths: list[Path], output: Path, options: dict[str, Any], common: Common
) -> tuple[dict[str, Any], list[Heading | TextTable], int]:
    from .. import ingest

    with progress(f"convert {paths[0].name}", common, counted=True) as report:
        counter = None if report is None else lambda messages: report(messages, 0)
        made = ingest.convert(paths, output, progress=counter, **options)
    findings = [finding_entry(f) for f in made.report.findings]
    channels = [
        {"topic": c.topic, "schema": c.schema, "count": c.count, "start_ns": c.start_ns, "end_ns": c.end_ns}
        for c in made.channels
    ]
    rows = {
        f"rows_{name}": getattr(made.report, f"rows_{name}")
        for name in ("read", "kept", "repaired", "dropped")
    }
    document = {
        "output": str(made.output),
        "format": made.format,
        "channels": channels,
        "also_read": [str(p) for p in made.also_read],
        "report": {**rows, "findings": findings},
    }
    lines: list[Heading | TextTable] = [
        Heading(f"{made.output} ({made.format})"),
        channel_table(channels),
        Heading(
            "rows: " + ", ".join(f"{count} {name.removeprefix('rows_')}" for name, count in rows.items())
        ),
        *([finding_table(findings)] if findings else []),
    ]
    return document, lines, DEFECTS if made.report.lossy else DONE


def _each(paths: tuple[Path, ...], folder: Path, options: dict[str, Any], common: Common) -> Outcome:
    """Convert every input on its own; see :func:`convert`."""
    from contextlib import ExitStack

    from ..ingest.batch import logs as find
    from ..ingest.convert import unpack_limit
    from ..recording.errors import MarchaError

    with ExitStack() as stack:
        batch = find(paths, stack, format=options["format"], unpack_limit_gb=unpack_limit(options["options"]))
        if not batch.logs:
            raise MarchaError(
                f"{paths[0]}: holds no log of a known format; marcha formats lists them, --format names one"
            )
        names = _names(batch.logs)
        folder.mkdir(parents=True, exist_ok=True)
        conversions: list[dict[str, Any]] = []
        lines: list[Heading | TextTable] = []
        codes = []
        for log in batch.logs:
            try:
                document, shown, code = _one([log], folder / names[log], options, common)
            except Exception as error:
                outcome = expected(error)
                if outcome is None:
                    raise
                line, code = batch.shown(outcome[0]), outcome[1]
                complain(line)
                document, shown = {"output": None, "error": line, "exit_code": code}, []
            conversions.append({"input": batch.shown(log), **document})
            lines += shown
            codes.append(code)
    taken = {path for made in conversions for path in made.get("also_read", ())}
    skipped = [(batch.shown(path), reason) for path, reason in batch.skipped if str(path) not in taken]
    done = sum(code in (DONE, DEFECTS) for code in codes)
    lines += [Heading(_summary(done, len(batch.logs), folder, skipped))]
    worst = next((c for c in codes if c not in (DONE, DEFECTS)), DEFECTS if DEFECTS in codes else DONE)
    document = {
        "output": str(folder),
        "conversions": conversions,
        "skipped": [{"input": path, "reason": reason} for path, reason in skipped],
    }
    return Outcome(document, lines, FAILED if done == 0 and worst == DONE else worst)


def _summary(done: int, logs: int, folder: Path, skipped: list[tuple[str, str]]) -> str:
    """Return what became of the files: converted, failed, and skipped ones by name."""
    summary = f"{done} of {logs} logs converted to {folder}"
    if done < logs:
        summary += f"; {logs - done} failed"
    if skipped:
        summary += f"; {len(skipped)} other files skipped:"
    return "\n".join([summary, *(f"  {path}: {reason}" for path, reason in skipped)])


def _names(logs: list[Path]) -> dict[Path, str]:
    """Return one file name an input; two that would share one are a usage error."""
    from ..recording.errors import UsageError

    names: dict[Path, str] = {}
    owners: dict[str, Path] = {}
    for log in logs:
        name = f"{log.stem}.mcap"
        other = owners.setdefault(name.lower(), log)
        if other != log:
            raise UsageError(f"{log} and {other} would both become {name}; convert them to different folders")
        names[log] = name
    return names
