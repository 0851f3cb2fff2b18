"""Find estimators by name and build them with checked parameters."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import msgspec

from .contract import AlgorithmError, PlainEstimator
from .parameters import describe

GROUP = "marcha.estimators"
CALIBRATIONS = "marcha.calibrations"


def available(group: str = GROUP) -> dict[str, Any]:
    """Return every installed estimator by name, sorted (with ``group=CALIBRATIONS``: every calibration).

    Built-in ones and plug-ins register alike, as entry points of the group. A plug-in that cannot be loaded, or
    that is of another kind, is left out with a warning that names it.
    """
    loaded = {p.name: _load(p, group) for p in _points(entry_points, tuple(sys.path), group)}
    return {name: cls for name, cls in loaded.items() if cls is not None}


def find(name: str, group: str = GROUP) -> Any:
    """Return the estimator class (or calibration) called ``name``.

    Raises
    ------
    AlgorithmError
        Where there is none; lists what there is.
    """
    points = [p for p in _points(entry_points, tuple(sys.path), group) if p.name == name]
    for point in points:
        cls = _load(point, group)
        if cls is not None:
            return cls
    kind = _METHODS[group][0]
    if points:
        raise AlgorithmError(
            f"{kind} {name!r} cannot be loaded (see the warning); available: {_names(available(group))}"
        )
    raise AlgorithmError(f"no {kind} {name!r}; available: {_names(available(group))}")


def make(name: str, /, *, preset: str | None = None, **params: Any) -> Any:
    """Build the estimator ``name``.

    Parameters
    ----------
    name : str
        ``foot.9iez`` …; see :func:`available`.
    preset : str, optional
        A named parameter set of the estimator; ``params`` go on top of it.
    **params
        Values of the estimator's own parameters; text is converted (``"0.1"`` to 0.1), as a command line
        needs.

    Raises
    ------
    AlgorithmError
        Unknown name, preset or parameter, or a value out of range: one line with the candidates.
    """
    cls = find(name)
    return cls(build_params(name, cls, {**_preset(name, cls, preset), **params}))


def build_params(name: str, cls: type[PlainEstimator], params: dict[str, Any]) -> msgspec.Struct:
    """Return ``cls.Params`` filled with ``params``; AlgorithmError where one is unknown or out of range."""
    fields = {p.name: p for p in describe(cls.Params)}
    unknown = sorted(set(params) - set(fields))
    if unknown:
        raise AlgorithmError(f"{name} has no parameter {unknown[0]!r}; it has: {_names(fields) or 'none'}")
    for key, value in params.items():
        try:
            taken = getattr(msgspec.convert({key: value}, cls.Params, strict=False), key)
            if isinstance(taken, float) and not math.isfinite(taken):
                raise ValueError("not finite")
        except (msgspec.ValidationError, ValueError) as error:
            field = fields[key]
            allowed = ", ".join(field.choices) or f"{field.type} {field.range}".strip()
            unit = f" ({field.unit})" if field.unit not in ("", "1") else ""
            raise AlgorithmError(
                f"{name}: {key} = {value!r} is not allowed; must be {allowed}{unit}"
            ) from error
    return msgspec.convert(params, cls.Params, strict=False)


def _preset(name: str, cls: type[PlainEstimator], preset: str | None) -> dict[str, Any]:
    if preset is None:
        return {}
    if preset not in cls.presets:
        raise AlgorithmError(f"{name} has no preset {preset!r}; it has: {_names(cls.presets) or 'none'}")
    return cls.presets[preset]


_METHODS = {GROUP: ("estimator", ("take", "step")), CALIBRATIONS: ("calibration", ("calibrate",))}


@lru_cache(maxsize=8)
def _points(scan: Callable[..., Any], path: tuple[str, ...], group: str = GROUP) -> tuple[EntryPoint, ...]:
    """Return the entry points by name. A scan of all that is installed takes 10 ms: one for each
    ``sys.path``.
    """
    return tuple(sorted(scan(group=group), key=lambda p: p.name))


def _load(point: Any, group: str = GROUP) -> Any:
    kind, methods = _METHODS[group]
    try:
        cls = point.load()
        if not (isinstance(cls, type) and any(callable(getattr(cls, m, None)) for m in methods)):
            raise TypeError(f"{cls!r} is not a class with a method {' or '.join(methods)}")
    except Exception as error:
        warnings.warn(
            f"{kind} plug-in {point.name!r} ({point.value}) cannot be loaded: {error}", stacklevel=3
        )
        return None
    return cls


def _names(names: Any) -> str:
    return ", ".join(sorted(names))
