"""What will run: estimators by name, their parameters, and which channels each one reads."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from typing import Any

import msgspec

from ..algorithms import find, make
from ..algorithms.contract import (
    AlgorithmError,
    Estimator,
    Input,
    Output,
    PlainEstimator,
)
from ..recording.errors import Finding, UsageError
from .sources import PlannedChannel, Source

_SPEC = re.compile(
    r"^(?:(?P<label>[A-Za-z0-9_-]+)=)?(?P<name>[^\[\]=\s]+)(?:\[(?P<params>.*)\])?$", re.DOTALL
)
NOT_RAW = ("/reference/", "/estimate/", "/annotation/")
"""Topics that an estimator never takes on its own."""


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


EstimatorLike = str | EstimatorSpec | PlainEstimator | Estimator | type
"""What the user may name an estimator by: its name, a specification, an instance or a class."""


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
    for part in _split(match["params"] or ""):
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


def _split(text: str) -> list[str]:
    """Split at commas outside of brackets and quotes."""
    parts, depth, quoted, start = [], 0, False, 0
    for i, sign in enumerate(text):
        if sign == '"':
            quoted = not quoted
        elif not quoted:
            depth += (sign in "[{") - (sign in "]}")
            if sign == "," and depth == 0:
                parts.append(text[start:i])
                start = i + 1
    parts.append(text[start:])
    return [p for p in (p.strip() for p in parts) if p]


@dataclass(frozen=True)
class PlannedRun:
    """One estimator on one set of channels.

    Attributes
    ----------
    run : str
        Id, also the part of the topics that tells runs apart.
    estimator : Estimator
        Fresh instance, used by this run only.
    name : str
        The estimator's name.
    version : str
        Distribution and version that the estimator comes from.
    params : dict
        Every parameter with its value.
    inputs : tuple of (str or None, tuple of str)
        Topic and columns of every input; None for an optional one that is not there.
    rate_hz : float
        Rate of the first input; 0 where it is not known.
    outputs : dict of str to PlannedChannel
        Channel of every output.
    findings : tuple of Finding
        What the user must know before the run.
    """

    run: str
    estimator: Estimator
    name: str
    version: str
    params: dict[str, Any]
    inputs: tuple[tuple[str | None, tuple[str, ...]], ...]
    rate_hz: float
    outputs: dict[str, PlannedChannel]
    findings: tuple[Finding, ...] = field(default=())

    @property
    def input(self) -> str:
        """Topic of the first input."""
        assert self.inputs[0][0] is not None
        return self.inputs[0][0]

    @property
    def latency(self) -> int:
        """Rows by which results lag behind."""
        return int(getattr(self.estimator, "latency", 0))

    @property
    def offline(self) -> bool:
        """Whether the estimator sees the whole recording before it answers."""
        return bool(getattr(self.estimator, "offline", False))


@dataclass(frozen=True)
class Plan:
    """All that a replay will do, for sinks to prepare.

    Attributes
    ----------
    source : str
        Name of the input.
    channels : dict of str to PlannedChannel
        Raw and estimate channels that will come, by topic.
    runs : tuple of PlannedRun
        The runs.
    """

    source: str
    channels: dict[str, PlannedChannel]
    runs: tuple[PlannedRun, ...]


def plan_runs(
    source: Source,
    estimators: Sequence[EstimatorLike],
    params: Mapping[str, Any] | None = None,
    inputs: Sequence[str] | None = None,
    taken: Sequence[str] = (),
) -> tuple[PlannedRun, ...]:
    """Decide which estimators run on which channels.

    Parameters
    ----------
    source : Source
        Where the messages will come from.
    estimators : sequence
        Names (``foot.9iez``, ``slow=foot.9iez[sigma_acc=0.01]``), or classes or instances of one's own.
    params : mapping, optional
        Parameters for every estimator that has them; those in the brackets of a name win.
    inputs : sequence of str, optional
        Topics to attach to. Without it every raw channel of the estimator's kind, one run each.
    taken : sequence of str
        Run ids that exist already; a new run of the same id gets a number and says so.

    Raises
    ------
    UsageError
        Unknown names, parameters or topics; no channel that fits; a missing column.
    """
    if not estimators:
        raise UsageError("no estimator given; `marcha estimators` lists them")
    params = dict(params or {})
    makers = [_Maker(e, params) for e in estimators]
    unused = [p for p in params if not any(p in m.shared for m in makers)]
    if unused:
        raise UsageError(f"parameter {unused[0]}: none of the estimators {[m.name for m in makers]} has it")
    for topic in inputs or ():
        if topic not in source.channels:
            raise UsageError(
                f"{source.name}: no channel {topic}; there are "
                f"{', '.join(t for t in source.channels if not t.startswith(NOT_RAW)) or 'none'}"
            )
    runs: list[PlannedRun] = []
    for maker in makers:
        for channels, notes in _attachments(maker.estimator.inputs, maker.name, source, inputs):
            primary = channels[0]
            assert primary is not None
            rate = source.rate_hz(primary.topic)
            estimator, values = maker.build(rate)
            parts = "_".join(p for p in primary.topic.split("/") if p)
            wanted = f"{_identifier(maker.label or maker.name)}_{_identifier(parts)}"
            run = _free(wanted, {*taken, *(r.run for r in runs)})
            if wanted in taken:
                notes = (
                    *notes,
                    Finding(
                        "renamed_run", 1, None, f"the recording has a run {wanted} already: this one is {run}"
                    ),
                )
            columns = tuple(
                (None if c is None else c.topic, i.columns)
                for c, i in zip(channels, estimator.inputs, strict=True)
            )
            runs.append(
                PlannedRun(
                    run,
                    estimator,
                    maker.name,
                    maker.version,
                    values,
                    columns,
                    rate,
                    _outputs(run, estimator, primary, maker),
                    notes,
                )
            )
    return tuple(runs)


class _Maker:
    """Builds fresh instances of one estimator that the user asked for."""

    def __init__(self, asked: EstimatorLike, params: Mapping[str, Any]) -> None:
        self.label = ""
        if isinstance(asked, str):
            asked = parse_estimator(asked)
        if isinstance(asked, EstimatorSpec):
            try:
                self.label, self.cls = asked.label, find(asked.name)
            except AlgorithmError as error:
                raise UsageError(str(error)) from None
            own, self._name = asked.params, asked.name
        elif isinstance(asked, type):
            self.cls, own, self._name = asked, {}, None
        else:
            self.cls, own, self._name = type(asked), {}, None
        self._instance = None if isinstance(asked, EstimatorSpec | type) else asked
        fields: tuple[str, ...] = getattr(getattr(self.cls, "Params", None), "__struct_fields__", ())
        known = {*fields, *(("preset",) if getattr(self.cls, "presets", None) and self._name else ())}
        self.shared = {} if self._instance is not None else {k: v for k, v in params.items() if k in known}
        self._given = self.shared | own
        self._rated = "rate_hz" in fields
        self.estimator = self._make(self._given)
        self.name = self._name or getattr(self.estimator, "name", "") or self.cls.__name__
        self.version = _version(self.cls)

    def _make(self, given: Mapping[str, Any]) -> Any:
        if self._instance is not None:
            return copy.deepcopy(self._instance)
        cls: Any = self.cls
        try:
            if self._name is not None:
                return make(self._name, **given)
            if not given:
                return cls()
            return cls(msgspec.convert(dict(given), cls.Params))
        except (AlgorithmError, msgspec.ValidationError) as error:
            raise UsageError(str(error)) from None

    def build(self, rate_hz: float) -> tuple[Any, dict[str, Any]]:
        """Return a fresh instance for a channel of this rate, and all its parameters."""
        estimator = self._make(self._given)
        params = getattr(estimator, "params", None)
        if self._rated and params is not None and not params.rate_hz and rate_hz > 0:
            if self._instance is None:
                estimator = self._make({**self._given, "rate_hz": rate_hz})
            else:
                build: Any = self.cls
                estimator = build(msgspec.structs.replace(params, rate_hz=rate_hz))
            params = estimator.params
        return estimator, msgspec.to_builtins(params) if isinstance(params, msgspec.Struct) else {}


def _attachments(
    wanted: Sequence[Input], name: str, source: Source, chosen: Sequence[str] | None
) -> list[tuple[tuple[PlannedChannel | None, ...], tuple[Finding, ...]]]:
    """Return for every run of an estimator the channel of each input, and what to say about the choice."""
    if not wanted:
        raise UsageError(f"estimator {name} declares no inputs")
    pool = [c for t, c in source.channels.items() if (t in chosen if chosen else not t.startswith(NOT_RAW))]
    if chosen:  # the user's order decides which is which
        pool.sort(key=lambda c: list(chosen).index(c.topic))
    fitting = [c for c in pool if c.schema == wanted[0].schema]
    if not fitting:
        kinds = ", ".join(f"{c.topic} ({c.schema})" for c in pool) or "none"
        raise UsageError(
            f"{source.name}: estimator {name} needs a channel of {wanted[0].schema}; there are {kinds}"
        )
    alike = [i for i, w in enumerate(wanted) if w.schema == wanted[0].schema and not w.optional]
    if len(alike) > 1:
        if len(fitting) != len(alike):
            topics = ", ".join(c.topic for c in fitting)
            raise UsageError(
                f"{source.name}: estimator {name} reads {len(alike)} channels of {wanted[0].schema} "
                f"together, there are {len(fitting)} ({topics}); name them in order with --input"
            )
        groups = [dict(zip(alike, fitting, strict=True))]
    else:
        groups = [{0: c} for c in fitting]
    result = []
    for group in groups:
        channels: list[PlannedChannel | None] = []
        notes: list[Finding] = []
        for i, need in enumerate(wanted):
            channel = group.get(i)
            if channel is None:
                channel, note = _companion(need, group[0], source, chosen, name)
                notes += note
            if channel is not None and (lacking := [c for c in need.columns if c not in channel.columns]):
                raise UsageError(
                    f"{source.name}: {channel.topic} has no column {lacking[0]}, which {name} reads; "
                    f"it has {', '.join(channel.columns)}"
                )
            channels.append(channel)
        result.append((tuple(channels), tuple(notes)))
    return result


def _companion(
    need: Input, primary: PlannedChannel, source: Source, chosen: Sequence[str] | None, name: str
) -> tuple[PlannedChannel | None, list[Finding]]:
    """Return the channel of a further input: the one named, or the only one of its kind beside the first."""
    beside = primary.topic.rpartition("/")[0] + "/"
    fitting = [c for c in source.channels.values() if c.schema == need.schema and c.topic != primary.topic]
    named = [c for c in fitting if chosen and c.topic in chosen]
    near = [c for c in fitting if c.topic.startswith(beside) and not c.topic.startswith(NOT_RAW)]
    candidates = named or near
    if len(candidates) == 1:
        return candidates[0], []
    topics = ", ".join(c.topic for c in candidates) or "none"
    if not need.optional:
        raise UsageError(
            f"{source.name}: estimator {name} on {primary.topic} needs one channel of {need.schema} "
            f"under {beside}; there are {topics}; name it with --input"
        )
    if not candidates:
        return None, []
    return None, [
        Finding(
            "ambiguous_input",
            len(candidates),
            None,
            f"{primary.topic}: runs without {need.schema}, since {topics} fit; name one with --input",
        )
    ]


def _outputs(
    run: str, estimator: Estimator, primary: PlannedChannel, maker: _Maker
) -> dict[str, PlannedChannel]:
    about = {
        "run": run,
        "estimator": maker.name,
        "version": maker.version,
        "input": primary.topic,
        "latency": str(getattr(estimator, "latency", 0)),
        "offline": "true" if getattr(estimator, "offline", False) else "false",
    }
    outputs: dict[str, PlannedChannel] = {}
    for output in estimator.outputs:
        if output.name in outputs:
            raise UsageError(f"estimator {maker.name} declares output {output.name} twice")
        frame = primary.frame_id if output.name in ("detector", "stance") else "nav"
        outputs[output.name] = PlannedChannel(
            f"/estimate/{run}/{output.name}",
            output.schema,
            frame,
            _table_columns(output),
            about | dict(output.metadata),
            run,
        )
    return outputs


def _table_columns(output: Output) -> tuple[str, ...]:
    """Return the columns of an output's table: kernels know no clock, so a step's swing becomes two times."""
    if output.schema == "marcha_msgs/msg/Step":
        return tuple(n for c in output.columns for n in (("start_ns", "end_ns") if c == "swing_s" else (c,)))
    return output.columns


def _identifier(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")


def _free(run: str, taken: set[str]) -> str:
    number, name = 2, run
    while name in taken:
        name, number = f"{run}_{number}", number + 1
    return name


@lru_cache(maxsize=256)
def _version(cls: type) -> str:
    """Return the distribution and version that a class comes from, its module where it is not installed."""
    package = cls.__module__.partition(".")[0]
    for entry in metadata.entry_points(group="marcha.estimators"):
        if entry.value.partition(":")[0].partition(".")[0] == package and entry.dist is not None:
            return f"{entry.dist.name} {entry.dist.version}"
    return cls.__module__
