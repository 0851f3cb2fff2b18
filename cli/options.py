"""Options that several commands share, and the values that are written in them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

if TYPE_CHECKING:
    from ..recording import Recording


@Parameter(name="*")
@dataclass(frozen=True)
class Common:
    """What every command understands."""

    json: Annotated[bool, Parameter(name="--json", negative="", group="Output")] = False
    """Print one JSON object on standard output and nothing else there."""

    quiet: Annotated[bool, Parameter(name=("--quiet", "-q"), negative="", group="Output")] = False
    """No progress on standard error."""


DEFAULT = Common()


def _named_mcap(kind: object, path: Path | str | None) -> None:
    """Refuse a recording by another name: ``-o y.txt`` would write what no text editor can read."""
    if path is None or str(path).endswith(("/", "\\")) or Path(path).is_dir():
        return
    if Path(path).suffix.lower() != ".mcap":
        raise ValueError(
            f"a recording's name ends in .mcap; give {Path(path).stem}.mcap, or a folder with a /"
        )


Force = Annotated[bool, Parameter(name="--force", negative="")]
Output = Annotated[Path, Parameter(name=("--output", "-o"))]
MaybeOutput = Annotated[Path | None, Parameter(name=("--output", "-o"))]
RecordingOutput = Annotated[Path, Parameter(name=("--output", "-o"), validator=_named_mcap)]
MaybeRecordingOutput = Annotated[Path | None, Parameter(name=("--output", "-o"), validator=_named_mcap)]
RecordingOrFolder = Annotated[str, Parameter(name=("--output", "-o"), validator=_named_mcap)]
QUIET = Parameter(negative="", show_default=False)
"""What holds for every parameter: no ``--no-…`` twin, and a default is said only where :data:`Shown`."""

Shown = Parameter(show_default=True)
"""Marks a default that help should state; the others go without saying."""
Strings = Annotated[tuple[str, ...], Parameter(negative="", consume_multiple=False)]
Paths = Annotated[tuple[Path, ...], Parameter(negative="", consume_multiple=False)]

_TIME = re.compile(
    r"(?P<at>@)?(?P<value>[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?)(?P<unit>ns|us|ms|s|m|min|h)?", re.IGNORECASE
)
_UNIT_NS = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": 10**9,
    "m": 60 * 10**9,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
}


def settings(pairs: tuple[str, ...], option: str) -> dict[str, str]:
    """Return ``k=v`` pairs as a dict; the package that takes them gives the values their types.

    Raises
    ------
    UsageError
        A pair without ``=``, or the same key twice with different values.
    """
    from ..recording.errors import UsageError

    values: dict[str, str] = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        key = key.strip()
        if not sign or not key:
            raise UsageError(
                f"{option} {pair}: is not of the form key=value, for example {option} rate_hz=100"
            )
        if values.setdefault(key, value.strip()) != value.strip():
            raise UsageError(
                f"{option} {key}: given twice, as {values[key]} and {value.strip()}; give it once"
            )
    return values


def limits(pairs: tuple[str, ...], option: str) -> dict[str, float]:
    """Return ``metric=number`` pairs as a dict of numbers; :func:`settings` states the errors."""
    from ..recording.errors import UsageError

    values: dict[str, float] = {}
    for key, value in settings(pairs, option).items():
        try:
            values[key] = float(value)
        except ValueError:
            raise UsageError(f"{option} {key}={value}: {value!r} is not a number") from None
    return values


def instant(text: str | None, rec: Recording, option: str) -> int | None:
    """Return a moment in the recording's own nanoseconds.

    Parameters
    ----------
    text : str or None
        ``12.5``, ``12.5s``, ``1m``, ``500ms``, ``250000ns``: that long after the start of the recording (a
        bare number is seconds). ``@1700000000000000000``: that many nanoseconds (or another unit,
        ``@12.5s``) on the recording's own clock. None stays None.
    rec : Recording
        Where the start is taken from.
    option : str
        Named in the error.

    Raises
    ------
    UsageError
        Anything else.
    """
    from decimal import Decimal

    from ..recording.errors import UsageError

    if text is None:
        return None
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise UsageError(
            f"{option} {text}: is not a time; give 12.5s, 1m or 500ms after the start, or @NANOSECONDS"
        )
    unit = _UNIT_NS[(match["unit"] or ("ns" if match["at"] else "s")).lower()]
    span = int((Decimal(match["value"]) * unit).to_integral_value())
    return span if match["at"] else (rec.start_ns or 0) + span


def spans(pairs: tuple[str, ...], rec: Recording, option: str) -> dict[str, list[tuple[int, int]]]:
    """Return stretches of time by topic from TOPIC=START:LENGTH, log time in nanoseconds, half open.

    Raises
    ------
    UsageError
        A text that is not of this form.
    """
    from ..recording.errors import UsageError

    result: dict[str, list[tuple[int, int]]] = {}
    for pair in pairs:
        topic, separator, text = pair.partition("=")
        begin, colon, length = text.rpartition(":")
        if not (separator and colon and begin and length):
            raise UsageError(f"{option} {pair}: write TOPIC=START:LENGTH, such as /phone/gnss=120:60s")
        start = instant(begin, rec, option)
        assert start is not None
        result.setdefault(topic, []).append((start, start + span_ns(length, option)))
    return result


def span_ns(text: str, option: str) -> int:
    """Return a length of time in nanoseconds: ``0.25``, ``250ms`` …; :func:`instant` states the errors."""
    from decimal import Decimal

    from ..recording.errors import UsageError

    match = _TIME.fullmatch(text.strip())
    if match is None or match["at"]:
        raise UsageError(f"{option} {text}: is not a length of time; give 0.25s or 250ms")
    return int((Decimal(match["value"]) * _UNIT_NS[(match["unit"] or "s").lower()]).to_integral_value())


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: NumPy scalars, paths and structs become numbers, text and dicts."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        return value.item()
    if hasattr(value, "tolist"):
        return value.tolist()
    raise NotImplementedError(f"{type(value).__name__} has no JSON form")


def recordings(paths: Sequence[Path], command: str) -> list[Path]:
    """Return the recordings that files and folders stand for; those of a folder by name.

    Raises
    ------
    UsageError
        None is named, or a folder holds none.
    """
    from ..recording.errors import UsageError

    if not paths:
        raise UsageError(f"{command}: name a recording or a folder of recordings")
    result: list[Path] = []
    for path in paths:
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise UsageError(f"{path}: holds no recording (*.mcap); `marcha convert` makes them of raw logs")
        result += inside
    return list(dict.fromkeys(result))
