"""Options of importers, exporters and simulators from what a user wrote: one parser for all."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar

import msgspec

from .errors import UsageError

T = TypeVar("T", bound=msgspec.Struct)


def options_of(
    kind: type[T], values: Mapping[str, Any], where: str, *, prefix: str = "", more: str = ""
) -> T:
    """Return ``values`` as a structure; text is converted ("true", "22.1", and "a, b" where several fit).

    Parameters
    ----------
    kind : type of msgspec.Struct
        The options that there are.
    values : mapping
        By name.
    where : str
        Whose options these are, for messages: ``format mpu6050-serial``.
    prefix : str
        What the user writes before each name.
    more : str
        What a message adds to the names that there are.

    Raises
    ------
    UsageError
        An option is unknown, or its value does not fit; the line names option, value and rule.
    """
    kinds = _kinds(kind)
    result: dict[str, Any] = {}
    for name, value in values.items():
        if name not in kinds:
            names = ", ".join(sorted(kinds)) or "none"
            raise UsageError(f"{where} has no option {prefix + name!r}; it has {names}{more}")
        several = isinstance(kinds[name], msgspec.inspect.VarTupleType)
        result[name] = (
            [part.strip() for part in value.split(",") if part.strip()]
            if several and isinstance(value, str)
            else value
        )
    try:
        return msgspec.convert(result, kind, strict=False)
    except msgspec.ValidationError as error:
        reason, _, path = str(error).partition(" - at `$.")
        name = path.rstrip("`")
        if not name:
            raise UsageError(f"{where}: {reason}") from None
        value = values.get(name.split("[")[0], "")
        raise UsageError(f"{where}: option {prefix}{name}={value!r}: {reason}") from None


@cache
def _kinds(kind: type[msgspec.Struct]) -> dict[str, msgspec.inspect.Type]:
    """Return the type of each option; to look it up in the annotations takes longer than all the rest."""
    about = msgspec.inspect.type_info(kind)
    assert isinstance(about, msgspec.inspect.StructType)
    return {field.name: _plain(field.type) for field in about.fields}


def _plain(kind: msgspec.inspect.Type) -> msgspec.inspect.Type:
    """Return a type without its constraints, and without None beside it."""
    if isinstance(kind, msgspec.inspect.Metadata):
        return _plain(kind.type)
    if isinstance(kind, msgspec.inspect.UnionType):
        types = [t for t in kind.types if not isinstance(t, msgspec.inspect.NoneType)]
        return _plain(types[0]) if len(types) == 1 else kind
    return kind
