"""``marcha calibrate``: a look at recordings whose result later replays are given."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from .console import Heading, Outcome, TextTable, progress
from .errors import DEFECTS, DONE
from .options import DEFAULT, Common, Force, MaybeOutput, Paths, Strings, instant, settings

MOST_ROWS = 24


def calibrate(
    name: str,
    paths: Paths,
    /,
    *,
    param: Annotated[Strings, Parameter(name=("--param", "-p"))] = (),
    inputs: Annotated[Strings, Parameter(name="--input")] = (),
    interval: str | None = None,
    start: Annotated[str | None, Parameter(name="--from")] = None,
    end: Annotated[str | None, Parameter(name="--to")] = None,
    output: MaybeOutput = None,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Let a calibration look at recordings and write its result.

    The file is handed to estimators by `marcha replay --calibration FILE`.
    Exit code 3 says that the recordings do not determine it ("not
    observable"); such a result is written for the record, but never applied.

    Parameters
    ----------
    name : str
        Calibration: imu, magnetometer …
    paths : Path
        Recordings that it looks at, together.
    param : str
        key=value; may be repeated.
    inputs : str
        ROLE=TOPIC, or a topic to attach to; may be repeated. Without it, every channel that fits, one result each.
    interval : str
        Label or tier of annotations: look only at what lies in them.
    start : str
        Start here: 12.5, 12.5s, 1m, 500ms after the recording's start, or @NANOSECONDS of its clock.
    end : str
        Stop before here; written like --from.
    output : Path
        File to write (JSON); with several results their subjects are added to the name.
    force : bool
        Replace existing outputs.
    """
    from .. import recording
    from .. import replay as rp

    recordings = [recording.open(path) for path in paths]
    with progress("calibrate", common):
        calibrations = rp.calibrate(
            name,
            recordings,
            settings(param, "--param"),
            inputs=list(inputs) or None,
            interval=interval,
            start_ns=instant(start, recordings[0], "--from"),
            end_ns=instant(end, recordings[0], "--to"),
        )
    written: list[Path] = []
    for one in calibrations:
        if output is not None:
            subject = "_".join(p for p in one.subject.split("/") if p)
            target = (
                output
                if len(calibrations) == 1
                else output.with_name(f"{output.stem}-{subject}{output.suffix}")
            )
            rp.save_calibration(one, target, overwrite=force)
            written.append(target)
    lines: list[Heading | TextTable] = []
    for one in calibrations:
        verdict = "" if one.usable else ": NOT USABLE"
        lines.append(Heading(f"{one.kind} of {one.subject or 'the recording'}{verdict}"))
        lines += _tables(one.values)
        lines += [Heading(f"note: {remark}") for remark in one.remarks]
    lines += [Heading(f"written: {path}") for path in written]
    import msgspec

    document = {"calibrations": msgspec.to_builtins(calibrations), "outputs": [str(w) for w in written]}
    return Outcome(document, lines, DONE if all(c.usable for c in calibrations) else DEFECTS)


def _tables(values: Mapping[str, Any]) -> list[Heading | TextTable]:
    """Return the values as tables: numbers first, then a table each for what there are several of (anchors)."""
    several = {
        key: [{"": name, **row} for name, row in value.items()] if isinstance(value, dict) else value
        for key, value in values.items()
        if _rows(value)
    }
    shown: list[Heading | TextTable] = [
        TextTable(["value", "is"], [(k, _shown(v)) for k, v in values.items() if k not in several])
    ]
    for key, rows in several.items():
        columns = list(
            dict.fromkeys(c for row in rows for c, v in row.items() if not isinstance(v, list | dict))
        )
        shown.append(
            Heading(f"{key}: {len(rows)}" + (f", the first {MOST_ROWS}" if len(rows) > MOST_ROWS else ""))
        )
        cells = [tuple(_shown(row.get(c, "")) for c in columns) for row in rows[:MOST_ROWS]]
        shown.append(TextTable(columns, cells))
    return shown


def _rows(value: object) -> bool:
    """Whether a value is several records, by number or by name."""
    parts = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    return bool(parts) and all(isinstance(p, dict) for p in parts)


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(_shown(v) for v in value) + "]"
    return str(value)
