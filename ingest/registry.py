"""Which importers there are, and which of them a source belongs to."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ..recording.errors import MarchaError, UsageError
from ..recording.files import files_below, require_regular
from ..recording.options import options_of
from ..recording.plugins import plugins
from .archive import UNPACK_LIMIT_GB, is_zip, unpacked
from .contract import HEAD_BYTES, CommonOptions, Importer
from .text import start_of
from .truth import is_side_file
from .workbook import is_workbook

GROUP = "marcha.importers"

#: Confidence below which a format is not a candidate, the lead that the first must have over the second, and that of
#: a file which is of its format whatever the user says of those beside it.
CANDIDATE, LEAD, SURE = 0.3, 0.1, 0.9


_UTF16 = "UTF-16 text; save it as UTF-8 (iconv -f UTF-16 -t UTF-8, or the editor's “Save as”)"
_OTHERS = {
    b"\x89MCAP": "a recording already (MCAP); marcha info and marcha replay take it as it is",
    b"\x1f\x8b": "compressed with gzip; unpack it first (gunzip)",
    b"BZh": "compressed with bzip2; unpack it first (bunzip2)",
    b"\xfd7zXZ\x00": "compressed with xz; unpack it first (unxz)",
    b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive; unpack it first",
    b"Rar!": "a RAR archive; unpack it first",
    b"PK\x03\x04": "a damaged zip archive (its table of contents is missing); copy or download it again",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook; save its sheet as CSV",
    b"SQLite format 3\x00": "an SQLite database (a ROS 2 bag?); convert the bag to MCAP first",
    b"\xff\xfe": _UTF16,
    b"\xfe\xff": _UTF16,
}
"""First bytes of files that a user may take for a log, and what to do with them."""


class Registered(NamedTuple):
    """One importer and where it comes from.

    Attributes
    ----------
    importer : Importer
        An instance.
    source : str
        Distribution and version, for provenance.
    """

    importer: Importer
    source: str


class OptionInfo(msgspec.Struct, frozen=True):
    """One option of a format: name, type, default and description, as text."""

    name: str
    type: str
    default: str
    description: str


class FormatInfo(msgspec.Struct, frozen=True):
    """One format as ``marcha formats`` shows it."""

    name: str
    title: str
    source: str
    joins: bool
    doc: str
    options: list[OptionInfo]


class Candidate(msgspec.Struct, frozen=True):
    """A format that may fit, and how surely."""

    name: str
    confidence: float


@cache
def importers() -> dict[str, Registered]:
    """Return all importers by name; a broken plug-in is a warning with its name."""
    result: dict[str, Registered] = {}
    for plugin in plugins(entry_points, GROUP, "importer", _checked).values():
        name = plugin.part.name
        if name in result:
            warnings.warn(
                f"importer plug-in {name} ({plugin.source}) is left out: {result[name].source} has the name already",
                stacklevel=2,
            )
            continue
        result[name] = Registered(plugin.part, plugin.source)
    return result


def get(name: str) -> Registered:
    """Return one importer.

    Raises
    ------
    UsageError
        There is none of that name.
    """
    registered = importers()
    if name not in registered:
        broken = " (its plug-in cannot be used)" if name in entry_points(group=GROUP).names else ""
        raise UsageError(f"unknown format {name!r}{broken}; one of {', '.join(registered)}")
    return registered[name]


def known_formats() -> list[FormatInfo]:
    """Return every format with its options and their documentation."""
    return [_info(r) for r in importers().values()]


def make_options(importer: Importer, values: Mapping[str, Any]) -> CommonOptions:
    """Build an importer's options from a mapping; text is converted ("true", "22.1").

    Raises
    ------
    UsageError
        An option is unknown or its value does not fit.
    """
    return options_of(importer.Options, values, f"format {importer.name}")


def recognise(path: Path, among: Collection[str] | None = None) -> list[Candidate]:
    """Return the formats that a file or folder may be, surest first; a folder as a whole, not what is in it.

    Parameters
    ----------
    path : Path
        Looked at, not read.
    among : collection of str, optional
        Only these formats look at it.

    Raises
    ------
    MarchaError
        The file cannot be read.
    """
    head = _head(path)
    candidates = []
    for name, (importer, _) in importers().items():
        if among is not None and name not in among:
            continue
        try:
            confidence = float(importer.sniff(head, path))
        except Exception as error:  # a plug-in's fault must not stop the others
            warnings.warn(f"importer {name} failed to look at {path}: {error!r}", stacklevel=2)
            continue
        if confidence >= CANDIDATE:
            candidates.append(Candidate(name, min(confidence, 1.0)))
    return sorted(candidates, key=lambda c: -c.confidence)


def chief_of(file: Path, format: str) -> Path:
    """Return the file or folder that stands for the recording which ``file`` is a part of."""
    chief = getattr(get(format).importer, "chief", None)
    return file if chief is None else chief(file)


class ChosenSource(NamedTuple):
    """One source of a recording: an importer and the files or folders that it reads together."""

    registered: Registered
    files: list[Path]


def choose(
    paths: Sequence[Path],
    format: str | None,
    stack: contextlib.ExitStack,
    *,
    mapped: str | None = None,
    unpack_limit_gb: float = UNPACK_LIMIT_GB,
) -> list[ChosenSource]:
    """Find the importers of a recording's sources, and the files or folders to hand to each.

    A folder is first offered whole, then its files; a zip archive is unpacked and taken for a folder. Inputs
    of different formats stand beside each other in one recording, each a source of its own; so do several
    of one format whose importer says so (``beside``), while one that joins them reads them as one source.

    Parameters
    ----------
    paths : sequence of Path
        What the user gave.
    format : str, optional
        Name of the format; without it content decides. Where some of several inputs are of this format, one that
        is surely of another keeps its own.
    stack : contextlib.ExitStack
        Keeps unpacked archives until it is closed.
    unpack_limit_gb : float
        Most that an archive may unpack to (GB).
    mapped : str, optional
        Format of inputs whose content belongs to none: that of a mapping which was given.

    Raises
    ------
    MarchaError
        Nothing there, unknown or ambiguous content, or several inputs of a format that takes one.
    """
    if not paths:
        raise UsageError("nothing to convert: give at least one file, folder or zip archive")
    wanted = get(format) if format else None
    others = _of_others([Path(p) for p in paths], wanted) if wanted is not None and len(paths) > 1 else ()
    chosen: list[tuple[str, Path]] = []
    for path in map(Path, paths):
        if mapped is not None and path.is_file() and not recognise(path):
            chosen.append((mapped, path))
        else:
            chosen += _resolve(path, None if path in others else wanted, stack, unpack_limit_gb)
    sources: list[ChosenSource] = []
    for name in dict.fromkeys(name for name, _ in chosen):
        registered = get(name)
        files = [p for n, p in chosen if n == name]
        if len(files) == 1 or (getattr(registered.importer, "joins", False) and len(paths) > 1):
            sources.append(ChosenSource(registered, files))
        elif getattr(registered.importer, "beside", False) and len(paths) > 1:
            sources += [ChosenSource(registered, [file]) for file in files]
        else:
            raise MarchaError(
                f"{files[0]}: {len(files)} recordings of format {name} "
                f"({', '.join(p.name for p in files[:3])} …); convert them one by one"
            )
    return sources


def _of_others(paths: Sequence[Path], wanted: Registered) -> list[Path]:
    """Return the files which are surely of another format than the one that the user names for those beside them."""
    files = [p for p in paths if p.is_file()]
    own = [p for p in files if recognise(p, [wanted.importer.name])]
    if not own:  # a format that is chosen by name only, or a file that does not look like its own
        return []
    return [p for p in files if p not in own and (c := recognise(p)) and c[0].confidence >= SURE]


def share_options(sources: Sequence[ChosenSource], values: Mapping[str, Any]) -> list[CommonOptions]:
    """Return the options of each source.

    ``name=value`` goes to every source whose format has the option, ``start`` and ``epoch`` to the first
    only: they speak of one clock; ``format.name=value`` goes to the sources of that format.

    Raises
    ------
    UsageError
        An option is unknown to all of them, or its value does not fit.
    """
    if len(sources) == 1 and not any(
        key.startswith(f"{sources[0].registered.importer.name}.") for key in values
    ):
        return [make_options(sources[0].registered.importer, values)]
    shares: list[dict[str, Any]] = [{} for _ in sources]
    for key, value in values.items():
        takers = []
        for k, (registered, _) in enumerate(sources):
            importer = registered.importer
            name = key.removeprefix(f"{importer.name}.")
            fields = {f.name for f in msgspec.structs.fields(importer.Options)}
            if name in fields and not (name == key and k > 0 and key in ("start", "epoch")):
                takers.append((k, name))
        if not takers:
            formats = ", ".join(dict.fromkeys(r.importer.name for r, _ in sources))
            raise UsageError(f"option {key!r}: none of the formats {formats} has it; see marcha formats")
        for k, name in takers:
            shares[k][name] = value
    return [make_options(r.importer, chosen) for (r, _), chosen in zip(sources, shares, strict=True)]


def _resolve(
    path: Path, wanted: Registered | None, stack: contextlib.ExitStack, limit_gb: float
) -> list[tuple[str, Path]]:
    """Return (format, file or folder) of everything that one input holds."""
    if not path.exists():
        raise MarchaError(f"{path}: no such file or folder")
    require_regular(path)
    folders = wanted is not None and getattr(wanted.importer, "folders", False)
    archive = path.is_file() and is_zip(path) and not is_workbook(path)
    # What a member stores uncompressed stands in the archive as it is: it must not be taken for the log itself.
    whole = [] if archive else _candidates(path, wanted)
    if not whole and wanted is not None and folders and path.is_dir():
        return [(wanted.importer.name, path)]
    if whole:
        return [(whole[0].name, path)]
    if path.is_dir():
        folder = path
    elif archive:
        folder = stack.enter_context(unpacked(path, limit_gb))
        if inner := _candidates(folder, wanted):
            return [(inner[0].name, folder)]
        if wanted is not None and folders:
            return [(wanted.importer.name, folder)]
    else:
        if wanted is not None:
            return [(wanted.importer.name, path)]
        if not path.stat().st_size:
            raise MarchaError(f"{path}: the file is empty; nothing to convert")
        raise MarchaError(f"{path}: {_known_otherwise(_head(path)) or f'unknown content; {_tried()}'}")
    files = [p for p in files_below(folder) if _is_data(p, folder)]
    if not files:
        raise MarchaError(f"{path}: the {'folder' if path.is_dir() else 'archive'} holds no files")
    parts = [(c[0].name, p) for p in files if (c := _candidates(p, wanted))]
    inside = list(dict.fromkeys((name, chief_of(p, name)) for name, p in parts))
    if not inside and wanted is not None and len(files) == 1:
        return [(wanted.importer.name, files[0])]
    if not inside and (packed := [p for p in files if is_zip(p)]):
        raise MarchaError(
            f"{path}: holds archives ({', '.join(p.name for p in packed[:4])}{' …' if packed[4:] else ''}); convert "
            "each log in them to a recording of its own with -o FOLDER/"
        )
    if not inside:
        raise MarchaError(f"{path}: unknown content in all of its {len(files)} files; {_tried()}")
    if len(inside) > 1:
        some = ", ".join(f"{p.relative_to(folder)} ({n})" for n, p in inside[:4])
        raise MarchaError(
            f"{path}: holds {len(inside)} recordings: {some}{' …' if len(inside) > 4 else ''}; "
            "convert them one by one, or each to a recording of its own with -o FOLDER/"
        )
    return inside


def _candidates(path: Path, wanted: Registered | None) -> list[Candidate]:
    """Return the formats that fit; of several only a clear leader."""
    if wanted is not None:
        return recognise(path, [wanted.importer.name])
    candidates = recognise(path)
    if len(candidates) > 1 and candidates[0].confidence - candidates[1].confidence < LEAD:
        listed = ", ".join(f"{c.name} ({c.confidence:.2f})" for c in candidates)
        raise MarchaError(f"{path}: could be {listed}; say which with --format")
    return candidates


def _tried() -> str:
    return f"tried {', '.join(importers())}; give --format, or --map with a TOML mapping of its columns"


def _known_otherwise(head: bytes) -> str:
    """Return what a file is that no importer reads, and the remedy; nothing where it is not known either."""
    for magic, reason in _OTHERS.items():
        if head.startswith(magic):
            return reason
    from .anchors import doubt_of_header

    return doubt_of_header(head)


def _is_data(path: Path, folder: Path) -> bool:
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in path.relative_to(folder).parts)
    return not hidden and not is_side_file(path)


def _head(path: Path) -> bytes:
    return b"" if path.is_dir() else start_of(path, HEAD_BYTES)


def _checked(kind: Any) -> Any:
    """Return an importer of a registered class; TypeError where it is none."""
    importer = kind()
    for field in ("name", "title", "Options", "sniff", "read"):
        if not hasattr(importer, field):
            raise TypeError(f"it has no {field!r}")
    if not issubclass(importer.Options, CommonOptions):
        raise TypeError("its Options do not inherit from CommonOptions")
    return importer


def _info(registered: Registered) -> FormatInfo:
    importer = registered.importer
    hints = msgspec.inspect.type_info(importer.Options)
    assert isinstance(hints, msgspec.inspect.StructType)
    options = [
        OptionInfo(f.name, _type_text(f.type), _default_text(f), _description(f.type)) for f in hints.fields
    ]
    doc = (importer.Options.__doc__ or "").strip().split("\n\n")[0]
    return FormatInfo(
        importer.name,
        importer.title,
        registered.source,
        bool(getattr(importer, "joins", False)),
        doc,
        options,
    )


def _default_text(field: msgspec.inspect.Field) -> str:
    if field.required:
        return "required"
    value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    return "" if value is None else str(value)


def _description(kind: msgspec.inspect.Type) -> str:
    extra = kind.extra_json_schema or {} if isinstance(kind, msgspec.inspect.Metadata) else {}
    return str(extra.get("description", ""))


def _type_text(kind: msgspec.inspect.Type) -> str:
    if isinstance(kind, msgspec.inspect.Metadata):
        return _type_text(kind.type)
    if isinstance(kind, msgspec.inspect.UnionType):
        return " or ".join(_type_text(t) for t in kind.types if not isinstance(t, msgspec.inspect.NoneType))
    if isinstance(kind, msgspec.inspect.LiteralType):
        return ", ".join(str(v) for v in kind.values)
    words = {"StrType": "text", "IntType": "integer", "FloatType": "number", "BoolType": "true or false"}
    return words.get(type(kind).__name__, type(kind).__name__.removesuffix("Type").lower())
