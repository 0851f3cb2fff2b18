"""Message definitions: ROS 2 ``.msg`` texts parsed into field trees.

The texts live in ``recording/msg/<package>/<Name>.msg``; everything else (byte layout, columns, schema
records) is derived from them. Definitions of foreign recordings come from their own schema records.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources

from .errors import MarchaError

PRIMITIVES: dict[str, str] = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""NumPy type of every primitive of fixed size."""

_PACKAGE = __name__.rpartition(".")[0]
_SEPARATOR = "=" * 80
_NAME = re.compile("[A-Za-z0-9_]+")
_LINE = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+"
    r"(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?\s*(?P<rest>.*)$"
)


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes
    ----------
    name : str
        Field name.
    type : str
        A key of :data:`PRIMITIVES`, ``string``, or a message type ``package/Name``.
    length : int or None
        None for a single value, -1 for a sequence, otherwise the length of a fixed array.
    """

    name: str
    type: str
    length: int | None = None


@dataclass(frozen=True)
class Definition:
    """A message type: its fields in order and its constants.

    Attributes
    ----------
    name : str
        ``package/Name``.
    fields : tuple of Field
        In the order of the wire.
    constants : dict of str to str
        Text of each constant's value.
    """

    name: str
    fields: tuple[Field, ...]
    constants: Mapping[str, str]

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of the fields."""
        return frozenset(f.name for f in self.fields)


Library = Mapping[str, Definition]
"""Message types by ``package/Name``."""


def short_name(name: str) -> str:
    """Return ``package/Name`` of ``package/msg/Name`` (or of itself)."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else name


def long_name(name: str) -> str:
    """Return ``package/msg/Name`` of ``package/Name`` (or of itself)."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[-1]}" if len(parts) > 1 else name


def parse(name: str, text: str) -> Definition:
    """Parse one definition.

    Parameters
    ----------
    name : str
        ``package/Name`` or ``package/msg/Name``.
    text : str
        The ``.msg`` text, without its dependencies.

    Returns
    -------
    Definition

    Raises
    ------
    MarchaError
        A line that is neither a field, a constant nor a comment.
    """
    name = short_name(name)
    package = name.split("/")[0]
    fields: list[Field] = []
    constants: dict[str, str] = {}
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.split("#", 1)[0].strip() if "'" not in raw and '"' not in raw else raw.strip()
        if not line or line.startswith("#"):
            continue
        match = _LINE.match(line)
        if match is None:
            raise MarchaError(f"{name}.msg line {number}: not a field or constant: {line!r}")
        if match["constant"] and not match["array"]:
            constants[match["name"]] = match["rest"].strip()
            continue
        array = match["array"]
        length = None if array is None else -1 if array == "[]" or "<=" in array else int(array[1:-1])
        fields.append(Field(match["name"], _resolve(match["type"], package), length))
    if not fields:  # what rosidl generates, since C has no empty struct
        fields.append(Field("structure_needs_at_least_one_member", "uint8"))
    return Definition(name, tuple(fields), constants)


def _resolve(type_: str, package: str) -> str:
    if type_ in PRIMITIVES or type_ in ("string", "wstring"):
        return type_
    if "/" in type_:
        return short_name(type_)
    if type_ == "Header":
        return "std_msgs/Header"
    if type_ in ("time", "duration"):  # spelling of ROS 1, still seen in generated texts
        return f"builtin_interfaces/{type_.capitalize()}"
    return f"{package}/{type_}"


def parse_full(name: str, text: str) -> dict[str, Definition]:
    """Parse a schema record: the top definition, then each dependency behind a line of ``=``.

    Parameters
    ----------
    name : str
        Type of the top definition.
    text : str
        Text of the schema record (encoding ``ros2msg``).

    Returns
    -------
    dict of str to Definition
        By ``package/Name``; the top one first.

    Raises
    ------
    MarchaError
        A malformed line, or a dependency that is neither in the text nor one of ours.
    """
    first, *rest = re.split(r"^={80}[ \t]*\r?\n", text, flags=re.MULTILINE)
    library = {short_name(name): parse(name, first)}
    for part in rest:
        head, _, body = part.partition("\n")
        if not head.startswith("MSG:"):
            raise MarchaError(
                f"schema {name}: expected 'MSG: package/Name' after the separator, got {head!r}"
            )
        definition = parse(head[4:].strip(), body)
        library[definition.name] = definition
    for definition in list(library.values()):
        for field in definition.fields:
            _require(field, library)
    return library


def _require(field: Field, library: dict[str, Definition]) -> None:
    if field.type in PRIMITIVES or field.type in library or field.type in ("string", "wstring"):
        return
    for name, definition in load(field.type).items():
        library.setdefault(name, definition)


def _text(name: str) -> str:
    package, _, base = short_name(name).partition("/")
    if not _NAME.fullmatch(package) or not _NAME.fullmatch(base):  # it becomes part of a path
        raise MarchaError(f"message type {name!r}: a name is package/Type, of letters, digits and _")
    file = resources.files(_PACKAGE).joinpath("msg", package, f"{base}.msg")
    try:
        return file.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise MarchaError(f"message type {name}: no definition is known for it") from None


@cache
def load(name: str) -> dict[str, Definition]:
    """Return one of our definitions with all that it needs, the top one first.

    Raises
    ------
    MarchaError
        No such type under ``recording/msg``.
    """
    top = parse(name, _text(name))
    library = {top.name: top}
    for field in top.fields:
        if field.type not in PRIMITIVES and field.type not in ("string", "wstring"):
            for key, definition in load(field.type).items():
                library.setdefault(key, definition)
    return library


@cache
def full_text(name: str) -> str:
    """Return the text of a schema record (encoding ``ros2msg``): ours with all dependencies."""
    first, *rest = load(name)
    return _text(first) + "".join(f"{_SEPARATOR}\nMSG: {n}\n{_text(n)}" for n in rest)


def known_types() -> Iterator[str]:
    """Yield ``package/Name`` of every definition kept here."""
    root = resources.files(_PACKAGE).joinpath("msg")
    for package in sorted(root.iterdir(), key=lambda p: p.name):
        for file in sorted(package.iterdir(), key=lambda p: p.name):
            if file.name.endswith(".msg"):
                yield f"{package.name}/{file.name[:-4]}"
