"""Which channel serves which input of an estimator.

The rule, in this order, for every input:

1. ``--input role=topic`` names it.
2. In a chain, the output of an earlier estimator whose message type and columns fit serves it: the one called
   like the input where several fit. An input with a ``stage`` is served by that estimator where the chain names
   none.
3. Else a raw channel whose message type and columns fit (topics named with ``--input`` alone limit the choice).
   Where topics have the input's name as a part (``/leg/thigh/imu`` for ``thigh``), only those count. Where they have
   it with a side (``/leg/left_thigh/imu``, ``/leg/right_thigh/imu``), every side makes a run of its own.
   The first required input decides about the device: without a name every fitting channel makes a run of its
   own. A further input takes the only fitting channel that is nearest to it: of the same device (``/phone/mag``
   beside ``/phone/imu``), else of the same body (``/leg/encoder`` beside ``/leg/thigh/imu``). Two inputs that
   ask for the same never share a channel; where as many channels are left as there are such inputs, they are
   taken in the order of the recording, and the run says so. A calibration's input that reads a reference takes one
   below ``/reference/`` instead.
4. Where this does not decide, a required input is an error that lists the candidates, an optional one stays
   empty and the run says so.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ..algorithms.contract import ALL_COLUMNS, Input
from ..recording.errors import Finding, UsageError
from .sources import PlannedChannel, Source

SIDES = ("left", "right")
NOT_RAW = ("/reference/", "/estimate/", "/annotation/")
"""Topics that an estimator never takes on its own."""


@dataclass(frozen=True)
class NamedChannels:
    """Channels that the user named.

    Attributes
    ----------
    topics : tuple of str
        Limits the choice for inputs that they fit.
    roles : mapping of str to tuple of str
        Topics by the name of the input.
    """

    topics: tuple[str, ...] = ()
    roles: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def parse(cls, texts: Iterable[str]) -> NamedChannels:
        """Read ``topic`` and ``role=topic``."""
        topics: list[str] = []
        roles: dict[str, tuple[str, ...]] = {}
        for text in texts:
            role, equals, topic = text.partition("=")
            if equals and not role.startswith("/"):
                roles[role] = (*roles.get(role, ()), topic)
            else:
                topics.append(text)
        return cls(tuple(topics), roles)

    def check(self, source: Source, inputs: Iterable[str]) -> None:
        """Raise UsageError for a topic that is not there or a role that no estimator has."""
        raw = ", ".join(t for t in source.channels if not t.startswith(NOT_RAW)) or "none"
        for topic in (*self.topics, *(t for topics in self.roles.values() for t in topics)):
            if topic not in source.channels:
                raise UsageError(f"{source.name}: no channel {topic}; there are {raw}")
        names = set(inputs)
        for role in self.roles:
            if role not in names:
                raise UsageError(
                    f"--input {role}=…: no estimator here has an input {role!r}; they have {sorted(names)}"
                )


@dataclass(frozen=True)
class ChannelAttachment:
    """Channels of one run, by input, and what to say about the choice."""

    channels: dict[str, tuple[PlannedChannel, ...]]
    findings: tuple[Finding, ...] = ()

    @property
    def primary(self) -> PlannedChannel:
        """Channel of the first input that has one."""
        return next(c for attached in self.channels.values() for c in attached)


def fits(need: Input, channel: PlannedChannel) -> bool:
    """Return whether a channel has the message type and columns that an input asks for."""
    return channel.schema == need.schema and (
        need.columns == ALL_COLUMNS or set(need.columns) <= set(channel.columns)
    )


def device_of(topic: str) -> str:
    """Return the part of a topic that names the device: all but its last part."""
    return topic.rpartition("/")[0] + "/"


def serving(need: Input, offers: Sequence[PlannedChannel], name: str) -> PlannedChannel | None:
    """Return the channel among the outputs of earlier stages that serves an input, the latest stage first.

    Raises
    ------
    UsageError
        Where several outputs of one stage fit and none is called like the input.
    """
    fitting = [c for c in offers if fits(need, c)]
    if not fitting:
        return None
    latest = [c for c in fitting if c.run == fitting[-1].run]
    named = [c for c in latest if c.topic.rpartition("/")[2] == need.name]
    if len(named) == 1 or len(latest) == 1:
        return (named or latest)[0]
    topics = ", ".join(c.topic for c in latest)
    raise UsageError(
        f"estimator {name}: input {need.name} fits {topics}; name one with --input {need.name}=TOPIC"
    )


def attach(
    inputs: Sequence[Input],
    name: str,
    source: Source,
    chosen: NamedChannels,
    served: Mapping[str, PlannedChannel],
    device: str = "",
) -> list[ChannelAttachment]:
    """Return the attachments of an estimator, one a run.

    Parameters
    ----------
    inputs : sequence of Input
        What it reads.
    name : str
        Its name, for messages.
    source : Source
        Whose channels there are.
    chosen : NamedChannels
        Channels that the user named.
    served : mapping of str to PlannedChannel
        Inputs that earlier stages serve.
    device : str
        Where channels of this device fit, only these.

    Raises
    ------
    UsageError
        No channel fits, or the rule does not decide.
    """
    if not inputs:
        raise UsageError(f"estimator {name} declares no inputs")
    first = _primary(inputs, served, chosen)
    fixed: dict[str, tuple[PlannedChannel, ...]] = {n: (c,) for n, c in served.items()}
    for need in inputs:
        if need.name in chosen.roles and need.name not in fixed:
            fixed[need.name] = _named(need, name, source, chosen)
    notes: list[Finding] = []
    if first is None:
        groups: list[dict[str, tuple[PlannedChannel, ...]]] = [{}]
    else:
        candidates = _candidates(first, source, chosen, only_named=True)
        candidates = (device and _nearest(candidates, device)) or candidates
        if not candidates:
            raise UsageError(_nothing_fits(first, name, source, chosen))
        partners = {t for i in inputs if _same_request(i, first) for t in chosen.roles.get(i.name, ())}
        own_side = f"{_side_of(partners)}_{first.name}"
        candidates = [c for c in candidates if c.topic not in partners]
        candidates = [c for c in candidates if partners and own_side in c.topic.split("/")] or candidates
        alike = [i for i in inputs if _same_request(i, first) and i.name not in fixed and not i.optional]
        if partners and len(alike) == 1 and not first.many and len(candidates) != 1:
            topics = ", ".join(c.topic for c in candidates) or "no other"
            raise UsageError(
                f"{source.name}: input {first.name} of {name} beside {', '.join(sorted(partners))}: there are "
                f"{topics}; name it with --input {first.name}=TOPIC"
            )
        sides = [] if partners else _sides(alike, source, chosen)
        if first.many:
            groups = [{first.name: tuple(candidates)}]
        elif sides:
            groups = [{i.name: (own[i.name],) for i in alike} for own in sides]
        elif len(alike) > 1:
            groups = [_together(alike, partners, name, source, chosen, notes)]
        else:
            groups = [{first.name: (c,)} for c in candidates]
    return [_complete(inputs, name, source, chosen, fixed | group, device, notes) for group in groups]


def _primary(inputs: Sequence[Input], served: Mapping[str, object], chosen: NamedChannels) -> Input | None:
    """Return the input that decides about the device: the first required one that nothing else serves."""
    free = [i for i in inputs if i.name not in served and i.name not in chosen.roles]
    return next((i for i in free if not i.optional), None)


def _same_request(a: Input, b: Input) -> bool:
    return a.schema == b.schema and a.columns == b.columns


def _candidates(
    need: Input, source: Source, chosen: NamedChannels, device: str = "", *, only_named: bool = False
) -> list[PlannedChannel]:
    """Return the raw channels that an input could take; of those, the ones nearest to the device if one is given.

    ``only_named``: topics that the user named alone are all there is.
    """
    named = [source.channels[t] for t in chosen.topics if fits(need, source.channels[t])]
    if named or (only_named and chosen.topics):
        return named
    apart = [t for t in source.channels if t.startswith("/reference/" if need.reference else NOT_RAW)]
    fitting = [c for t, c in source.channels.items() if fits(need, c) and (t in apart) == need.reference]
    fitting = [c for c in fitting if need.name in c.topic.split("/")] or fitting
    return fitting if need.many or need.reference or not device else _nearest(fitting, device)


def _nearest(channels: list[PlannedChannel], device: str) -> list[PlannedChannel]:
    """Return the channels that share most of the leading parts of a device's topics, at least one part."""
    parts = device.strip("/").split("/")
    for length in range(len(parts), 0, -1):
        prefix = "/" + "/".join(parts[:length]) + "/"
        if near := [c for c in channels if c.topic.startswith(prefix)]:
            return near
    return []


def _named(need: Input, name: str, source: Source, chosen: NamedChannels) -> tuple[PlannedChannel, ...]:
    channels = tuple(source.channels[t] for t in chosen.roles[need.name])
    for channel in channels:
        if channel.schema != need.schema:
            raise UsageError(
                f"{source.name}: {channel.topic} is {channel.schema}; input {need.name} of {name} reads {need.schema}"
            )
        lacking = [] if need.columns == ALL_COLUMNS else [c for c in need.columns if c not in channel.columns]
        if lacking:
            raise UsageError(_lacks(channel, lacking[0], name, source))
    if len(channels) > 1 and not need.many:
        raise UsageError(
            f"estimator {name}: input {need.name} takes one channel, --input names {len(channels)}"
        )
    return channels


def _lacks(channel: PlannedChannel, column: str, name: str, source: Source) -> str:
    return (
        f"{source.name}: {channel.topic} has no column {column}, which {name} reads; "
        f"it has {', '.join(channel.columns)}"
    )


def _nothing_fits(need: Input, name: str, source: Source, chosen: NamedChannels) -> str:
    pool = [source.channels[t] for t in chosen.topics] or [
        c for t, c in source.channels.items() if not t.startswith(NOT_RAW)
    ]
    alike = [c for c in pool if c.schema == need.schema]
    lacking = [c for c in need.columns if alike and c not in alike[0].columns and need.columns != ALL_COLUMNS]
    if lacking:
        return _lacks(alike[0], lacking[0], name, source)
    kinds = ", ".join(f"{c.topic} ({c.schema})" for c in pool) or "none"
    return (
        f"{source.name}: estimator {name} needs a channel of {need.schema} for its input {need.name}; "
        f"there are {kinds}"
    )


def _sides(alike: Sequence[Input], source: Source, chosen: NamedChannels) -> list[dict[str, PlannedChannel]]:
    """Return, for every side on which all of the inputs have a channel of their name, these channels."""
    sides = []
    for side in SIDES:
        pool = _candidates(Input("", alike[0].schema, alike[0].columns), source, chosen, only_named=True)
        own = {i.name: [c for c in pool if f"{side}_{i.name}" in c.topic.split("/")] for i in alike}
        if all(len(channels) == 1 for channels in own.values()):
            sides.append({name: channels[0] for name, channels in own.items()})
    return sides


def _side_of(topics: Iterable[str]) -> str:
    """Return the side that topics speak of (``/leg/left_thigh/imu``); empty without one."""
    parts = [part for topic in topics for part in topic.split("/")]
    return next((side for side in SIDES if any(part.startswith(f"{side}_") for part in parts)), "")


def _together(
    alike: Sequence[Input],
    partners: Collection[str],
    name: str,
    source: Source,
    chosen: NamedChannels,
    notes: list[Finding],
) -> dict[str, tuple[PlannedChannel, ...]]:
    """Give each of several inputs that ask for the same a channel of its own; ``partners`` are given away."""
    group: dict[str, tuple[PlannedChannel, ...]] = {}
    # without a name: that of the first input must not hide the channels of the others
    pool = _candidates(Input("", alike[0].schema, alike[0].columns), source, chosen, only_named=True)
    pool = [c for c in pool if c.topic not in partners]
    for need in alike:
        by_role = [c for c in pool if need.name in c.topic.split("/")]
        if len(by_role) == 1:
            group[need.name] = (by_role[0],)
    taken = {c.topic for (c,) in group.values()}
    rest = [n for n in alike if n.name not in group]
    left = [c for c in pool if c.topic not in taken]
    if rest and len(rest) != len(left):
        topics = ", ".join(c.topic for c in left) or "none"
        roles = ", ".join(n.name for n in rest)
        raise UsageError(
            f"{source.name}: estimator {name} reads {len(rest)} channels of {alike[0].schema} together "
            f"({roles}), there are {len(left)} ({topics}); name them with --input {rest[0].name}=TOPIC"
        )
    for need, channel in zip(rest, left, strict=False):
        group[need.name] = (channel,)
    if rest and not chosen.topics:
        pairs = ", ".join(f"{n.name} = {group[n.name][0].topic}" for n in rest)
        notes.append(
            Finding(
                "attached_by_order",
                len(rest),
                None,
                f"{pairs}: taken in the order of the recording, since no topic has the inputs' names; "
                f"name them with --input {rest[0].name}=TOPIC",
            )
        )
    return group


def _complete(
    inputs: Sequence[Input],
    name: str,
    source: Source,
    chosen: NamedChannels,
    have: Mapping[str, tuple[PlannedChannel, ...]],
    device: str,
    notes: Sequence[Finding],
) -> ChannelAttachment:
    """Attach the further inputs of one run."""
    findings = list(notes)
    channels: dict[str, tuple[PlannedChannel, ...]] = {}
    raw = [c for attached in have.values() for c in attached if not c.run]
    beside = device_of(raw[0].topic) if raw else device
    side = _side_of(c.topic for c in raw)
    for need in inputs:
        if need.name in have:
            channels[need.name] = have[need.name]
            continue
        candidates = _candidates(need, source, chosen, beside)
        own = {c.topic for i in inputs if _same_request(i, need) for c in have.get(i.name, ())}
        candidates = [c for c in candidates if c.topic not in own]
        if side and not need.many:
            mine = [
                c
                for c in _candidates(need, source, chosen)
                if f"{side}_{need.name}" in c.topic.split("/") and c.topic not in own
            ]
            both = [c for c in candidates if not _side_of([c.topic])]
            named = [c for c in both if need.name in c.topic.split("/")]
            candidates = mine or named or (both if not _same_request(need, inputs[0]) else [])
        if need.many or len(candidates) == 1:
            channels[need.name] = tuple(candidates)
        elif not candidates:
            channels[need.name] = ()
        else:
            channels[need.name] = ()
            topics = ", ".join(c.topic for c in candidates)
            if need.optional:
                findings.append(
                    Finding(
                        "ambiguous_input",
                        len(candidates),
                        None,
                        f"{raw[0].topic if raw else name}: runs without {need.schema}, since {topics} fit; "
                        f"name one with --input {need.name}=TOPIC",
                    )
                )
            else:
                raise UsageError(
                    f"{source.name}: estimator {name} needs one channel of {need.schema} for its input "
                    f"{need.name}; there are {topics}; name it with --input {need.name}=TOPIC"
                )
        if not channels[need.name] and not need.optional:
            raise UsageError(
                _nothing_fits(need, name, source, chosen) + f"; name it with --input {need.name}=TOPIC"
            )
    return ChannelAttachment({i.name: channels[i.name] for i in inputs}, tuple(findings))
