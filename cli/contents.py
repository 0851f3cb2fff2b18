"""``marcha info`` and ``marcha check``: what is inside a recording, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import (
    Heading,
    Outcome,
    TextTable,
    complain,
)
from .errors import DEFECTS, DONE
from .options import DEFAULT, Common

if TYPE_CHECKING:
    from ..recording import Recording


def info(path: Path, /, *, common: Common = DEFAULT) -> Outcome:
    """Show what a recording holds.

    Parameters
    ----------
    path : Path
        The recording.
    """
    from .. import recording

    rec = recording.open(path)
    channels = channel_entries(rec)
    annotations = rec.annotations
    document = {
        "path": str(path),
        "duration_s": rec.duration_s,
        "start_ns": rec.start_ns,
        "end_ns": rec.end_ns,
        "channels": channels,
        "metadata": rec.metadata,
        "attachments": [
            {"name": a.name, "media_type": a.media_type, "size": a.size} for a in rec.attachments
        ],
        "annotations": annotations.height,
        "findings": [finding_entry(f) for f in rec.findings],
    }
    lines: list[Heading | TextTable] = [
        Heading(f"{path}: {rec.duration_s:.3f} s, {len(channels)} channels"),
        channel_table(channels),
    ]
    for name, values in rec.metadata.items():
        lines += [
            Heading(f"\n{name}"),
            TextTable(["  key", "value"], [["  " + k, v] for k, v in values.items()], cut=True),
        ]
    if rec.attachments:
        lines += [
            Heading(""),
            TextTable(
                ["attachment", "type", ">bytes"], [[a.name, a.media_type, a.size] for a in rec.attachments]
            ),
        ]
    if annotations.height:
        lines += [Heading(f"\n{annotations.height} annotations (marcha annotate list)")]
    if rec.findings:
        lines += [Heading(""), finding_table(document["findings"])]
    return Outcome(document, lines)


def channel_entries(rec: Recording) -> list[dict[str, Any]]:
    """Return the channels as other programs read them."""
    return [
        {
            "topic": c.topic,
            "schema": c.schema,
            "count": c.count,
            "start_ns": c.start_ns,
            "end_ns": c.end_ns,
            "frame_id": c.frame_id,
        }
        for c in rec.channels.values()
    ]


def channel_table(channels: list[dict[str, Any]]) -> TextTable:
    """Return the channels with their mean rate."""
    rows = []
    for c in channels:
        span_s = (c["end_ns"] - c["start_ns"]) / 1e9 if c["count"] else 0.0
        rate = (c["count"] - 1) / span_s if span_s > 0 else None
        rows.append([c["topic"], c["schema"], c["count"], span_s, rate])
    return TextTable(["topic", "schema", ">messages", ">span [s]", ">rate [Hz]"], rows)


def finding_entry(finding: Any) -> dict[str, Any]:
    """Return a finding as other programs read it."""
    return {
        "kind": finding.kind,
        "count": finding.count,
        "first_line": finding.first_line,
        "detail": finding.detail,
    }


def finding_table(findings: list[dict[str, Any]]) -> TextTable:
    """Return findings for a person."""
    return TextTable(
        ["finding", ">count", ">first line", "what it means"],
        [[f["kind"], f["count"], f["first_line"], f["detail"]] for f in findings],
    )


def check(path: Path, /, *, common: Common = DEFAULT) -> Outcome:
    """Look for what is wrong with a recording.

    Reports what a damaged file has lost, gaps, times that repeat or run
    backwards, missing values and dead sensors, and repeats what the import
    found in the raw log. Exit code 3 where anything is wrong.

    Parameters
    ----------
    path : Path
        The recording.
    """
    from .. import recording
    from ..recording.check import check as examine

    rec = recording.open(path)
    findings = [finding_entry(f) for f in examine(rec)]
    imported, lossy = import_report(rec)
    if not findings and not imported:
        verdict = "nothing is wrong"
    else:
        verdict = "look at this" if findings else "the recording is sound; the raw log was not"
        if not findings and not lossy:
            verdict = "nothing is wrong; the import made remarks"
    lines: list[Heading | TextTable] = [Heading(f"{path}: {verdict}")]
    if findings:
        lines.append(finding_table(findings))
    if imported:
        lines += [Heading("\nwhat the import found in the raw log"), finding_table(imported)]
    document = {"path": str(path), "findings": findings, "import_findings": imported}
    return Outcome(document, lines, DEFECTS if findings or lossy else DONE)


def say_losses(*recs: Recording) -> None:
    """Say on standard error what could not be read of a damaged recording, as far as it was read."""
    for rec in recs:
        for finding in rec.findings:
            complain(f"warning: {rec.path}: {finding.kind}: {finding.detail}")


def import_report(rec: Recording) -> tuple[list[dict[str, Any]], bool]:
    """Return what the import of a recording found, and whether data was lost or repaired.

    Nothing and false where the recording was not imported by marcha.
    """
    import msgspec

    from ..recording.errors import Finding

    record = rec.metadata.get("import_report", {})
    try:
        findings = msgspec.json.decode(record.get("findings", "[]"), type=list[Finding])
    except msgspec.MsgspecError:  # another program's record of this name
        return [], False
    return [finding_entry(f) for f in findings], record.get("lossy") == "true"
