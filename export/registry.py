"""Which exporters there are, and the one call that runs one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from ..recording import Recording
from ..recording.errors import UsageError, overflow_unsaid
from ..recording.files import require_other
from ..recording.options import options_of
from ..recording.plugins import plugins
from .contract import Exporter

GROUP = "marcha.exporters"


def available() -> dict[str, type[Exporter]]:
    """Return the exporters that are installed, by name; a broken plug-in is a warning that names it."""
    return {name: plugin.part for name, plugin in plugins(entry_points, GROUP, "exporter").items()}


def export(
    rec: Recording,
    to: str,
    path: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write a recording in another tool's format.

    Parameters
    ----------
    rec : Recording
        What to write.
    to : str
        Name of an exporter, for example ``csv``; :func:`available` lists them.
    path : Path or str
        File or folder to write.
    options : mapping, optional
        Options of the exporter by name; text is converted to the option's type.
    overwrite : bool
        Whether an earlier export at ``path`` may be replaced.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    UsageError
        Unknown exporter or option, or ``path`` is the recording itself.
    OutputExists
        ``path`` exists and ``overwrite`` is false.
    """
    chosen = _exporter(to)
    require_other(path, [rec.path])
    with overflow_unsaid():
        return chosen().export(rec, Path(path), _options(chosen, options), overwrite=overwrite)


def export_all(
    recs: Sequence[Recording],
    to: str,
    path: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write several recordings: one dataset where the format has datasets, else a file or folder each in a folder.

    Parameters
    ----------
    recs, to, path, options, overwrite
        See :func:`export`; ``path`` is a folder.

    Raises
    ------
    UsageError
        Unknown exporter or option, or two recordings of one name.
    OutputExists
        An output exists and ``overwrite`` is false.
    """
    chosen = _exporter(to)
    together = getattr(chosen, "export_all", None)
    if together is not None:
        with overflow_unsaid():
            return together(chosen(), recs, Path(path), _options(chosen, options), overwrite=overwrite)
    names = [rec.path.stem + chosen.suffix for rec in recs]
    if len(set(names)) != len(names):
        raise UsageError(f"{path}: two recordings would have one name; export them one by one")
    Path(path).mkdir(parents=True, exist_ok=True)
    return [
        file
        for rec, name in zip(recs, names, strict=True)
        for file in export(rec, to, Path(path) / name, options=options, overwrite=overwrite)
    ]


def _exporter(to: str) -> type[Exporter]:
    exporters = available()
    if to not in exporters:
        raise UsageError(f"export format {to!r}: not known; there are {', '.join(exporters)}")
    return exporters[to]


def losses(rec: Recording, to: str, *, options: Mapping[str, Any] | None = None) -> list[str]:
    """Return what of a recording a format cannot hold, a line each; nothing is written.

    Parameters
    ----------
    rec, to, options
        See :func:`export`.

    Raises
    ------
    UsageError
        Unknown exporter or option.
    """
    chosen = _exporter(to)
    say = getattr(chosen, "losses", None)  # plug-ins of the first version do not have it
    return say(chosen(), rec, _options(chosen, options)) if say is not None else []


def _options(exporter: type[Exporter], options: Mapping[str, Any] | None) -> Any:
    return options_of(exporter.Options, options or {}, f"export format {exporter.name}")
