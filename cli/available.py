"""``marcha formats`` and ``marcha estimators``: what is installed, with parameters."""

from __future__ import annotations

from typing import Any

from .console import Heading, Outcome, TextTable
from .options import DEFAULT, Common


def formats(*, common: Common = DEFAULT) -> Outcome:
    """List the formats that can be read and written."""
    import msgspec

    from .. import export
    from ..ingest.registry import known_formats as readable

    readers = msgspec.to_builtins(readable())
    writers = [
        {"name": name, "title": kind.title, "options": _parameters(kind.Options)}
        for name, kind in export.available().items()
    ]
    document = {"importers": readers, "exporters": writers}
    lines: list[Heading | TextTable] = []
    for title, entries in (
        ("convert reads (options: --set)", readers),
        ("export writes (options: --set)", writers),
    ):
        lines.append(Heading(f"{title}\n"))
        for entry in entries:
            lines += [
                Heading(f"{entry['name']}: {entry['title']}"),
                TextTable(
                    ["  option", "default", "meaning"],
                    [["  " + o["name"], str(o["default"] or ""), o["description"]] for o in entry["options"]],
                ),
                Heading(""),
            ]
    return Outcome(document, lines)


def estimators(*names: str, common: Common = DEFAULT) -> Outcome:
    """List estimators and calibrations, with parameters of those named.

    Parameters
    ----------
    names : str
        Estimators or calibrations to describe in full.
    """
    from .. import algorithms

    calibrations = algorithms.available(algorithms.CALIBRATIONS)
    for name in names:
        if name not in calibrations:
            algorithms.find(name)  # an unknown one is an error that lists them
    entries = [
        {
            "name": name,
            "title": kind.title,
            "source": kind.source,
            "offline": kind.offline,
            "parameters": _parameters(kind.Params),
            "presets": kind.presets,
        }
        for name, kind in algorithms.available().items()
        if not names or name in names
    ]
    described = [
        {"name": name, "title": kind.title, "source": kind.source, "parameters": _parameters(kind.Params)}
        for name, kind in calibrations.items()
        if not names or name in names
    ]
    if not names:
        listed = TextTable(
            ["calibration (marcha calibrate)", "what it is"], [[c["name"], c["title"]] for c in described]
        )
        lines = [*_overview(entries)[:-1], Heading(""), listed, *_overview(entries)[-1:]]
        return Outcome({"estimators": entries, "calibrations": described}, lines)
    entries += [c | {"offline": False, "presets": {}} for c in described]
    lines: list[Heading | TextTable] = []
    for entry in entries:
        offline = " (offline: needs the whole recording)" if entry["offline"] else ""
        lines.append(Heading(f"{entry['name']}: {entry['title']}{offline}"))
        if entry["source"]:
            lines.append(Heading(f"  source: {entry['source']}"))
        lines.append(
            TextTable(
                ["  parameter", ">default", "unit", "range", "meaning"],
                [
                    [
                        "  " + p["name"],
                        str(p["default"]),
                        p["unit"],
                        p["range"] or ", ".join(p["choices"]),
                        p["description"],
                    ]
                    for p in entry["parameters"]
                ],
            )
        )
        for preset, values in entry["presets"].items():
            chosen = ", ".join(f"{key}={value}" for key, value in values.items())
            lines.append(Heading(f"  preset {preset}: {chosen}"))
        lines.append(Heading(""))
    return Outcome({"estimators": entries}, lines)


def _overview(entries: list[dict[str, Any]]) -> list[Heading | TextTable]:
    """Return one line an estimator, and the named parameter sets."""
    rows = [[e["name"], f"{e['title']}{' (offline)' if e['offline'] else ''}"] for e in entries]
    sets: dict[tuple[str, str], list[str]] = {}
    for entry in entries:
        for preset, values in entry["presets"].items():
            chosen = ", ".join(f"{key}={value}" for key, value in values.items())
            sets.setdefault((preset, chosen), []).append(entry["name"])
    shared = [
        [preset, chosen, "all" if len(those) == len(entries) else ", ".join(those)]
        for (preset, chosen), those in sets.items()
    ]
    lines: list[Heading | TextTable] = [TextTable(["estimator", "what it is"], rows)]
    if shared:
        lines += [Heading(""), TextTable(["preset (-p preset=…)", "sets", "of"], shared)]
    return [
        *lines,
        Heading("\nmarcha estimators NAME… shows the parameters, with units, ranges and defaults"),
    ]


def _parameters(struct: Any) -> list[dict[str, Any]]:
    """Return what the fields of a struct say about themselves."""
    from ..algorithms.parameters import describe

    return [
        {
            "name": p.name,
            "type": p.type,
            "default": p.default,
            "unit": p.unit,
            "range": p.range,
            "choices": list(p.choices),
            "description": p.effect,
            "source": p.source,
        }
        for p in describe(struct)
    ]
