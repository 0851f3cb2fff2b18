"""Estimators as a user names them: ``label=name[parameter=value,…]``."""

from __future__ import annotations

import json
import re
from typing import Any

import msgspec

from ..recording.errors import UsageError

_SPEC = re.compile(
    r"^(?:(?P<label>[A-Za-z0-9_-]+)=)?(?P<name>[^\[\]=\s]+)(?:\[(?P<params>.*)\])?$", re.DOTALL
)


class EstimatorSpec(msgspec.Struct, frozen=True):
    """An estimator as the user asks for it: ``label=name[key=value,…]``.

    Attributes
    ----------
    name : str
        Name of a registered estimator.
    params : dict
        Parameters that differ from the defaults; ``preset`` names a set of them.
    label : str
        Takes the name's place in the run's id.
    """

    name: str
    params: dict[str, Any] = {}
    label: str = ""


def parse_estimator(text: str) -> EstimatorSpec:
    """Read ``name``, ``name[key=value,…]`` or ``label=name[…]``.

    Values are JSON where they can be (numbers, true, false, null, lists), else plain words.

    Raises
    ------
    UsageError
        Where the text has another form.
    """
    match = _SPEC.match(text.strip())
    if match is None:
        raise UsageError(f"estimator {text!r}: expected name, name[key=value,…] or label=name[key=value,…]")
    params: dict[str, Any] = {}
    for part in split_outside_brackets(match["params"] or ""):
        key, equals, value = part.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"estimator {text!r}: {part!r} is not key=value")
        if key.strip() in params:
            raise UsageError(f"estimator {text!r}: {key.strip()} is given twice")
        params[key.strip()] = parse_value(value.strip())
    return EstimatorSpec(match["name"], params, match["label"] or "")


def parse_value(text: str) -> Any:
    """Return the JSON value that ``text`` is, else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def split_outside_brackets(text: str, separator: str = ",") -> list[str]:
    """Split at a separator outside of brackets and quotes."""
    parts, depth, quoted, start = [], 0, False, 0
    for i, sign in enumerate(text):
        if sign == '"':
            quoted = not quoted
        elif not quoted:
            depth += (sign in "[{") - (sign in "]}")
            if sign == separator and depth == 0:
                parts.append(text[start:i])
                start = i + 1
    parts.append(text[start:])
    return [p for p in (p.strip() for p in parts) if p]
