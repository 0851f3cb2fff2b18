"""What will run: estimators by name, their parameters, and which channels each one reads."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from typing import Any

import msgspec

from ..algorithms import find, make
from ..algorithms.calibration import Calibration
from ..algorithms.contract import (
    ALL_COLUMNS,
    AlgorithmError,
    ChannelInfo,
    Context,
    Estimator,
    Output,
    PlainEstimator,
    RowEstimator,
)
from ..recording.errors import Finding, UsageError
from ..recording.names import free_name
from .attachment import ChannelAttachment, NamedChannels, attach, device_of, serving
from .calibrations import calibrations_of, usable
from .messages import AttachedChannel
from .sources import PlannedChannel, Source
from .specs import EstimatorSpec, parse_estimator, split_outside_brackets

EstimatorLike = str | EstimatorSpec | PlainEstimator | Estimator | type
"""What the user may name an estimator by: its name, a specification, an instance or a class."""


@dataclass(frozen=True)
class PlannedRun:
    """One estimator on one set of channels.

    Attributes
    ----------
    run : str
        Id, also the part of the topics that tells runs apart.
    estimator : Estimator
        Fresh instance, used by this run only; its ``start`` is through.
    name : str
        The estimator's name.
    version : str
        Distribution and version that the estimator comes from.
    params : dict
        Every parameter with its value.
    inputs : tuple of AttachedChannel
        Channels of all inputs, in the order of the inputs.
    rate_hz : float
        Rate of the first input; 0 where it is not known.
    outputs : dict of str to PlannedChannel
        Channel of every output.
    findings : tuple of Finding
        What the user must know before the run.
    calibrations : tuple of Calibration
        Those that it was given.
    """

    run: str
    estimator: Any
    name: str
    version: str
    params: dict[str, Any]
    inputs: tuple[AttachedChannel, ...]
    rate_hz: float
    outputs: dict[str, PlannedChannel]
    findings: tuple[Finding, ...] = ()
    calibrations: tuple[Calibration, ...] = ()

    @property
    def input(self) -> str:
        """Topic of the first channel."""
        return self.inputs[0].topic

    @property
    def topics(self) -> dict[str, tuple[str, ...]]:
        """Topics by input; empty for an optional one that is not there."""
        return {
            i.name: tuple(c.topic for c in self.inputs if c.input == i.name) for i in self.estimator.inputs
        }

    @property
    def latency(self) -> int:
        """Rows by which results lag behind."""
        return int(getattr(self.estimator, "latency", 0))

    @property
    def offline(self) -> bool:
        """Whether the estimator sees the whole recording before it answers."""
        return bool(getattr(self.estimator, "offline", False))

    @property
    def takes_rows(self) -> bool:
        """Whether it is fed rows, not messages."""
        return takes_rows(self.estimator)

    @property
    def row_inputs(self) -> tuple[tuple[str | None, tuple[str, ...]], ...]:
        """Topic and columns of every input of an estimator that takes rows; None for one that is not there."""
        return tuple(
            (next(iter(topics), None), i.columns)
            for i, topics in zip(self.estimator.inputs, self.topics.values(), strict=True)
        )


def takes_rows(estimator: Any) -> bool:
    """Return whether an estimator is fed rows (``step``), not messages (``take``)."""
    if isinstance(estimator, RowEstimator):
        return True
    own = getattr(type(estimator), "take", None)
    return own is None or (own is PlainEstimator.take and callable(getattr(estimator, "step", None)))


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
        The runs; one that reads another's outputs comes after it.
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
    calibrations: Sequence[Calibration] = (),
) -> tuple[PlannedRun, ...]:
    """Decide which estimators run on which channels; see :mod:`.attachment` for the rule.

    Parameters
    ----------
    source : Source
        Where the messages will come from.
    estimators : sequence
        Names (``foot.9iez``, ``slow=foot.9iez[sigma_acc=0.01]``), chains of them (``phone.steps+phone.pdr``), or
        classes or instances of one's own.
    params : mapping, optional
        Parameters for every estimator that has them; those in the brackets of a name win.
    inputs : sequence of str, optional
        ``role=topic``, or topics alone. Without it every raw channel of the estimator's kind, one run each.
    taken : sequence of str
        Run ids that exist already; a new run of the same id gets a number and says so.
    calibrations : sequence of Calibration
        Handed to estimators, before those that the recording has.

    Raises
    ------
    UsageError
        Unknown names, parameters or topics; no channel that fits; a missing column; a circle of stages.
    """
    if not estimators:
        raise UsageError("no estimator given; `marcha estimators` lists them")
    params = dict(params or {})
    chains = [[_Maker(e, params) for e in _chain(asked)] for asked in estimators]
    makers = [m for c in chains for m in c]
    chosen = NamedChannels.parse(inputs or ())
    planner = _Planner(source, params, chosen, taken, calibrations)
    stages = [s for m in makers for s in planner.default_stages(m)]
    unused = [p for p in params if not any(p in m.shared for m in (*makers, *stages))]
    if unused:
        raise UsageError(f"parameter {unused[0]}: none of the estimators {[m.name for m in makers]} has it")
    chosen.check(source, (i.name for m in (*makers, *stages) for i in m.estimator.inputs))
    for chain in chains:
        planner.add_chain(chain)
    return tuple(planner.runs)


def _chain(asked: EstimatorLike) -> Sequence[EstimatorLike]:
    """Return the stages of what the user asked for."""
    return split_outside_brackets(asked, "+") if isinstance(asked, str) else [asked]


class _Planner:
    """Attaches one chain after another; stages that are alike are planned once."""

    def __init__(
        self,
        source: Source,
        params: Mapping[str, Any],
        chosen: NamedChannels,
        taken: Sequence[str],
        calibrations: Sequence[Calibration],
    ) -> None:
        self.source = source
        self.params = params
        self.chosen = chosen
        self.taken = tuple(taken)
        self.calibrations = usable((*calibrations, *calibrations_of(source.metadata)))
        self.runs: list[PlannedRun] = []

    def default_stages(self, maker: _Maker, above: tuple[str, ...] = ()) -> list[_Maker]:
        """Return the estimators that serve this one's inputs unless others are named, nearest last."""
        if maker.name in above:
            raise UsageError(f"estimators serve one another in a circle: {' → '.join((*above, maker.name))}")
        stages: list[_Maker] = []
        for need in maker.estimator.inputs:
            if need.stage:
                stage = _Maker(need.stage, self.params)
                stages += [*self.default_stages(stage, (*above, maker.name)), stage]
        return stages

    def add_chain(self, chain: Sequence[_Maker]) -> None:
        """Plan the runs of a chain."""
        offers: list[PlannedChannel] = []
        for place, maker in enumerate(chain):
            planned = self.add(maker, offers, "", own=place == len(chain) - 1)
            offers += [c for run in planned for c in run.outputs.values()]

    def add(
        self, maker: _Maker, offers: Sequence[PlannedChannel], device: str, own: bool = True
    ) -> list[PlannedRun]:
        """Plan the runs of one estimator behind the outputs ``offers``; ``own``: the user asked for it by itself."""
        inputs = maker.estimator.inputs
        served: dict[str, PlannedChannel] = {}
        for need in inputs:
            if need.name in self.chosen.roles:
                continue
            channel = serving(need, offers, maker.name)
            if channel is not None:
                served[need.name] = channel
        staged = [i for i in inputs if i.stage and i.name not in served and i.name not in self.chosen.roles]
        attachments = (
            attach(
                [i for i in inputs if i not in staged], maker.name, self.source, self.chosen, served, device
            )
            if len(staged) < len(inputs)
            else [ChannelAttachment({})]
        )
        planned: list[PlannedRun] = []
        for attachment in attachments:
            channels, notes = dict(attachment.channels), list(attachment.findings)
            raw = [c.topic for attached in channels.values() for c in attached if not c.run]
            beside = device_of(raw[0]) if raw else device
            behind: list[dict[str, tuple[PlannedChannel, ...]]] = [{}]
            for need in staged:
                stage = _Maker(need.stage, self.params)
                runs = self.add(stage, offers, beside, own=False)
                offered = [serving(need, list(r.outputs.values()), maker.name) for r in runs]
                fitting = [c for c in offered if c is not None]
                if not fitting:
                    raise UsageError(
                        f"estimator {maker.name}: its stage {need.stage} has no output that fits input {need.name}"
                    )
                if raw or len(behind) > 1:
                    fitting = fitting[:1]
                behind = [b | {need.name: (c,)} for b in behind for c in fitting]
            for served_by in behind:
                whole = {i.name: (channels | served_by).get(i.name, ()) for i in inputs}
                planned.append(self._plan(maker, ChannelAttachment(whole, tuple(notes)), own))
        return planned

    def _plan(self, maker: _Maker, attachment: ChannelAttachment, own: bool) -> PlannedRun:
        primary, notes = attachment.primary, list(attachment.findings)
        rate = 0.0 if primary.run else self.source.rate_hz(primary.topic)
        estimator, values = maker.build(rate)
        attached = tuple(
            AttachedChannel(
                need.name,
                index,
                number,
                channel.topic,
                channel.columns if need.columns == ALL_COLUMNS else need.columns,
                need.regular,
                0.0 if channel.run else self.source.rate_hz(channel.topic),
            )
            for index, need in enumerate(estimator.inputs)
            for number, channel in enumerate(attachment.channels[need.name])
        )
        if not own:
            for r in self.runs:
                if (r.name, r.params, r.inputs) == (maker.name, values, attached):
                    return r
        parts = "_".join(p for p in _origin(primary).split("/") if p)
        wanted = f"{_identifier(maker.label or maker.name)}_{_identifier(parts)}"
        run = free_name(wanted, {*self.taken, *(r.run for r in self.runs)})
        if wanted in self.taken:
            detail = f"the recording has a run {wanted} already: this one is {run}"
            notes.append(Finding("renamed_run", 1, None, detail))
        calibrations = self.calibrations
        if hasattr(estimator, "start"):
            try:
                estimator.start(self._context(attached, attachment, calibrations))
            except AlgorithmError as error:
                raise UsageError(f"{self.source.name}: estimator {maker.name}: {error}") from None
        offline = [
            r.run
            for r in self.runs
            if r.offline and any(c.topic.startswith(f"/estimate/{r.run}/") for c in attached)
        ]
        if offline and not getattr(estimator, "offline", False):
            raise UsageError(
                f"estimator {maker.name} is causal and cannot read {offline[0]}, whose results come at the end only"
            )
        planned = PlannedRun(
            run,
            estimator,
            maker.name,
            maker.version,
            values,
            attached,
            rate,
            _outputs(run, estimator, attachment, maker),
            tuple(notes),
            tuple(calibrations.values()),
        )
        self.runs.append(planned)
        return planned

    def _context(
        self,
        attached: Sequence[AttachedChannel],
        attachment: ChannelAttachment,
        calibrations: Mapping[str, Calibration],
    ) -> Context:
        infos: dict[str, list[ChannelInfo]] = {name: [] for name in attachment.channels}
        for one in attached:
            channel = attachment.channels[one.input][one.number]
            infos[one.input].append(
                ChannelInfo(
                    one.topic, channel.schema, channel.frame_id, one.columns, one.rate_hz, channel.metadata
                )
            )
        by_kind = {c.kind: c for c in reversed(list(calibrations.values()))}
        return Context(
            {name: tuple(channels) for name, channels in infos.items()},
            self.source.metadata,
            self.source.attachments,
            self.source.static,
            {**by_kind, **calibrations},
        )


def _origin(channel: PlannedChannel) -> str:
    """Return the raw topic that a channel goes back to: runs are called after it."""
    return channel.metadata.get("input", channel.topic) if channel.run else channel.topic


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
        names = {*fields, *(("preset",) if getattr(self.cls, "presets", None) and self._name else ())}
        self.shared = {} if self._instance is not None else {k: v for k, v in params.items() if k in names}
        self._given = self.shared | own
        self._rated = "rate_hz" in fields
        self.estimator = self._make(self._given)
        self.name = self._name or getattr(self.estimator, "name", "") or self.cls.__name__
        self.version = _version(self.cls)

    def _make(self, params: Mapping[str, Any]) -> Any:
        if self._instance is not None:
            return copy.deepcopy(self._instance)
        cls: Any = self.cls
        try:
            if self._name is not None:
                return make(self._name, **params)
            if not params:
                return cls()
            return cls(msgspec.convert(dict(params), cls.Params))
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


def _outputs(
    run: str, estimator: Any, attachment: ChannelAttachment, maker: _Maker
) -> dict[str, PlannedChannel]:
    about = {
        "run": run,
        "estimator": maker.name,
        "version": maker.version,
        "input": _origin(attachment.primary),
        "latency": str(getattr(estimator, "latency", 0)),
        "offline": "true" if getattr(estimator, "offline", False) else "false",
    }
    outputs: dict[str, PlannedChannel] = {}
    for output in estimator.outputs:
        if output.name in outputs:
            raise UsageError(f"estimator {maker.name} declares output {output.name} twice")
        attached = attachment.channels.get(output.frame, ())
        outputs[output.name] = PlannedChannel(
            f"/estimate/{run}/{output.name}",
            output.schema,
            attached[0].frame_id if attached else output.frame,
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


@lru_cache(maxsize=256)
def _version(cls: type) -> str:
    """Return the distribution and version that a class comes from, its module where it is not installed."""
    package = cls.__module__.partition(".")[0]
    for entry in metadata.entry_points(group="marcha.estimators"):
        if entry.value.partition(":")[0].partition(".")[0] == package and entry.dist is not None:
            return f"{entry.dist.name} {entry.dist.version}"
    return cls.__module__
