"""What a study is: recordings × estimators × parameters, and how the results are grouped and tested.

A study is described in one TOML file; :class:`StudyConfig` is its exact shape, and unknown keys are refused.
A preset is such a file that ships with marcha.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatchcase
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from ..algorithms import available
from ..recording import MarchaError, UsageError
from ..recording.files import parse_toml, read_small
from .withheld import Withheld

NonNegative = Annotated[int, msgspec.Meta(ge=0)]
_PACKAGE = __name__.rpartition(".")[0]

Positive = Annotated[int, msgspec.Meta(ge=1)]
Level = str | bool | int | float
"""Value of a parameter that is a factor."""

RESERVED = (
    "metric", "unit", "filter", "configuration", "recording", "input", "estimator", "preset", "params",
    "status", "error", "clipped", "value",
)  # fmt: skip
"""Columns of the tables that no factor may be called by."""


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=False):
    """One TOML table."""


class TruthRule(_Table, frozen=True, kw_only=True):
    """What is known about the walks whose file name matches.

    Attributes
    ----------
    pattern : str
        Regular expression, searched in the file's name. The first rule that fits a file counts.
    closed : bool or None
        Whether the walk ends where it began.
    length_m : float or None
        True length in metres.
    survey : str
        File of fixes along the same route at another time, beside the walk or below its folder.
    """

    pattern: str = ""
    survey: str = ""
    closed: bool | None = None
    length_m: Annotated[float, msgspec.Meta(gt=0)] | None = None


class Recordings(_Table, frozen=True, kw_only=True):
    """Recordings on disk.

    Attributes
    ----------
    files : list of str
        Globs below the data folder (``--data``, else the folder of the TOML file). ``**`` descends.
    format : str or None
        Importer for the raw files; None finds it by content. ``.mcap`` files are taken as they are.
    options : dict
        Options of the importer, as ``convert --set`` takes them.
    truth : list of TruthRule
        What is known about the walks; it goes into the recordings that the study converts.
    """

    files: list[str] = msgspec.field(default_factory=lambda: ["*"])
    format: str | None = None
    options: dict[str, Any] = {}
    truth: list[TruthRule] = []


class Simulate(_Table, frozen=True, kw_only=True):
    """Walks to simulate: every scenario × configuration × walk is one recording.

    Attributes
    ----------
    scenarios : list of str
        Scenarios of ``marcha simulate``.
    walks : int
        Walks of each scenario and configuration.
    seed : int
        First seed. Every walk of the study has a seed of its own, so that samples are independent.
    options : dict
        Options of the simulator for all walks. A list of two numbers ``[low, high]`` under ``vary`` is drawn
        anew for each walk.
    vary : dict of str to [low, high]
        Options drawn uniformly for each walk from its seed (walking speed, stride …).
    configurations : dict of str to dict
        Sensor configurations: label to the simulator's options (full scales …), ``walks`` for a number of its own.
    """

    scenarios: list[str]
    walks: Positive = 30
    seed: NonNegative = 1
    options: dict[str, Any] = {}
    vary: dict[str, tuple[float, float]] = {}
    configurations: dict[str, dict[str, Any]] = msgspec.field(default_factory=lambda: {"simulated": {}})


class Grouping(_Table, frozen=True, kw_only=True):
    r"""Rule that gives a recording's input its configuration.

    Attributes
    ----------
    pattern : str
        Regular expression, searched in the file's name.
    label : str
        Label; ``\1`` or ``\g<name>`` insert what the groups of the pattern matched.
    input : str
        Glob of the input topics that the rule is for.
    """

    pattern: str
    label: str
    input: str = "*"


class Estimators(_Table, frozen=True, kw_only=True):
    """One estimator with its parameters; a list of values spans a grid.

    Attributes
    ----------
    name : str
        Name as ``marcha estimators`` lists it.
    label : str
        Name in tables and figures; the estimator's own by default.
    presets : list of str
        Named parameter sets of the estimator, one variant each; the empty name stands for its defaults.
    params : dict
        Parameters. A list is a grid axis; give a list of lists for a parameter that is itself a list.
    factors : dict of str to list
        Replaces the levels of the study's factors for this estimator; an empty list takes it out of one.
    """

    name: str
    label: str = ""
    presets: list[str] = msgspec.field(default_factory=lambda: [""])
    params: dict[str, Any] = {}
    factors: dict[str, list[Level]] = {}


class Metric(_Table, frozen=True, kw_only=True):
    """A column of the results that is tabulated, drawn and tested.

    Attributes
    ----------
    column : str
        Metric as ``marcha evaluate`` names it, or ``run_time_s``.
    title : str
        Short name in tables and figures.
    unit : str
        Unit behind the numbers.
    absolute : bool
        Take the magnitude (a signed end height becomes an altitude error).
    scale : float
        Factor from the column to the unit.
    log : bool
        Draw on a logarithmic axis.
    """

    column: str
    title: str = ""
    unit: str = ""
    absolute: bool = False
    scale: float = 1.0
    log: bool = False


#: What is tabulated where a study does not say.
USUAL_METRICS = (
    Metric(column="closure_m", title="closure", unit="m"),
    Metric(column="distance_m", title="distance", unit="m"),
    Metric(column="height_end_m", title="end height", unit="m"),
    Metric(column="run_time_s", title="run time", unit="s", log=True),
)


class Statistics(_Table, frozen=True, kw_only=True):
    """Options of the statistics.

    Attributes
    ----------
    confidence : float
        Level of tests and intervals.
    outlier_sigma : float
        Values farther than this many standard deviations from their group's mean are left out; 0 keeps all.
    min_samples : int
        Groups smaller than this are listed, not tested.
    nonparametric : str
        The twin of Welch's test.
    """

    confidence: Annotated[float, msgspec.Meta(gt=0.5, lt=1)] = 0.95
    outlier_sigma: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    min_samples: Annotated[int, msgspec.Meta(ge=3)] = 3
    nonparametric: Literal["mann-whitney", "brunner-munzel"] = "mann-whitney"


class Published(_Table, frozen=True, kw_only=True):
    """Published values to stand beside the measured ones.

    Attributes
    ----------
    metric : str
        Title of the metric of this study that they belong to.
    origin : str
        Where they come from.
    scale : float
        Factor from the published numbers to the metric's unit.
    rows : dict of str to dict of str to float
        Row label to column label to published mean.
    by : str
        What the rows are, ``estimator`` or a factor; the columns are configurations.
    estimator : str
        Estimator that the table holds fixed; empty where it is the row.
    levels : dict of str to str
        Levels of the factors that the table holds fixed.
    sd, maximum, minimum : dict
        Published standard deviations and extremes, same shape.
    table : str
        Number of the table in the source.
    note : str
        What a reader must know about the numbers.
    """

    metric: str
    origin: str
    rows: dict[str, dict[str, float]]
    scale: float = 1.0
    by: str = "estimator"
    estimator: str = ""
    levels: dict[str, str] = {}
    sd: dict[str, dict[str, float]] = {}
    maximum: dict[str, dict[str, float]] = {}
    minimum: dict[str, dict[str, float]] = {}
    table: str = ""
    note: str = ""


class Verdict(_Table, frozen=True, kw_only=True):
    """What a publication finds best.

    Attributes
    ----------
    metric : str
        Title of the study's metric.
    smallest : list of str
        Combinations with the smallest mean, equal among each other: filter and configuration, ``9IEZ C00``.
    """

    metric: str
    smallest: list[str]


class StudyConfig(_Table, frozen=True, kw_only=True):
    """A whole study; see the classes of its parts.

    Attributes
    ----------
    title, description : str
        Head of the report.
    recordings, simulate : Recordings, Simulate or None
        Where the walks come from; at least one.
    inputs : list of str
        Globs of the topics that estimators are attached to.
    configurations : list of Grouping
        Rules in order; the first that fits counts. A simulated walk has the configuration it was made with,
        and rules are searched in its name.
    estimators : list of Estimators
        What runs.
    factors : dict of str to list
        Parameters that every estimator is run with several values of: name to the values, or to names of the
        estimators' presets that set one (``detector = ["shoe", "shoe-tuned"]``). The first is the level that
        tables and tests between estimators use. A parameter that is not named keeps the estimators' default.
    metrics : list of Metric
        What is tabulated and tested. Every metric is in ``results.parquet`` anyway.
    published : list of Published
        Values of a publication beside the measured ones; every relation between rows is checked.
    verdicts : list of Verdict
        Its verdicts.
    tracks : bool
        Keep thinned tracks and draw them.
    by : str
        Tier of annotations (``terrain``, ``turn``): the metrics are also taken by its labels and between them,
        and compared. A rule of this name (``turn``, ``stair`` …) is applied where a recording has no such tier.
    withhold : list of Withheld
        Stretches of channels that no estimator gets; errors are taken against them.
    """

    title: str = "Study"
    description: str = ""
    recordings: Recordings | None = None
    simulate: Simulate | None = None
    inputs: list[str] = msgspec.field(default_factory=lambda: ["*"])
    configurations: list[Grouping] = []
    estimators: list[Estimators]
    factors: dict[str, list[Level]] = {}
    metrics: list[Metric] = msgspec.field(default_factory=lambda: list(USUAL_METRICS))
    statistics: Statistics = Statistics()
    published: list[Published] = []
    verdicts: list[Verdict] = []
    tracks: bool = True
    by: str = ""
    withhold: list[Withheld] = []


class Method(msgspec.Struct, frozen=True):
    """One point of the grid: an estimator with one set of parameters.

    Attributes
    ----------
    estimator : str
        Registered name.
    label : str
        The filter's name in tables, with what varies in the grid (``9IEZ sigma_acc=0.1``).
    levels : dict of str to str
        Level of every factor of the study; empty where the estimator is not part of it.
    preset : str
        Named parameter set that ``params`` override.
    params : dict
        Parameters, those of the factors included.
    """

    estimator: str
    label: str
    levels: dict[str, str] = {}
    preset: str = ""
    params: dict[str, Any] = {}


def presets() -> list[str]:
    """Return the names of the studies that ship with marcha."""
    folder = resources.files(_PACKAGE) / "presets"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def load(config: str | Path | StudyConfig) -> tuple[StudyConfig, Path | None]:
    """Read a study's TOML, or a preset by its name.

    Returns
    -------
    (StudyConfig, Path or None)
        The checked configuration, and the folder that relative globs start from (None for a preset).

    Raises
    ------
    UsageError
        Where the file or preset does not exist or does not have the shape of :class:`StudyConfig`.
    """
    if isinstance(config, StudyConfig):
        return check(config, "the configuration"), None
    path = Path(config)
    if path.is_file():
        data, base = read_small(path), path.resolve().parent
    elif path.name == str(config) and str(config) in presets():
        data, base = (resources.files(_PACKAGE) / "presets" / f"{config}.toml").read_bytes(), None
    else:
        raise UsageError(f"{config}: no such file, and not a preset; presets are {', '.join(presets())}")
    try:
        parsed: StudyConfig = parse_toml(data, str(config), StudyConfig)
    except MarchaError as error:
        raise UsageError(str(error)) from None
    return check(parsed, str(config)), base


def check(config: StudyConfig, name: str) -> StudyConfig:
    """Return ``config`` if it makes sense as a whole; raise UsageError with ``name`` in front otherwise."""

    def no(message: str) -> UsageError:
        return UsageError(f"{name}: {message}")

    if config.recordings is None and config.simulate is None:
        raise no("nothing to study; give a [recordings] or a [simulate] table")
    if not config.estimators:
        raise no("no estimators; add an [[estimators]] table")
    if not config.metrics:
        raise no("no metrics; leave `metrics` out for the usual ones")
    for rule in [*config.configurations, *(config.recordings.truth if config.recordings else [])]:
        try:
            pattern = re.compile(rule.pattern)
        except re.error as error:
            raise no(f"pattern {rule.pattern!r} is no regular expression: {error}") from None
        if isinstance(rule, Grouping):
            try:  # an empty alternative matches any text: the groups are checked without a file
                match = re.compile(f"{rule.pattern}|").search("")
                assert match is not None
                match.expand(rule.label)
            except (re.error, IndexError) as error:
                raise no(f"label {rule.label!r} does not fit pattern {pattern.pattern!r}: {error}") from None
    for e in config.estimators:
        for key, value in e.params.items():
            if isinstance(value, list) and not value:
                raise no(f"{e.name}: parameter {key} has an empty list of values")
        for factor, levels in _levels(config, e).items():
            if factor in e.params and levels != [""]:
                raise no(f"{e.name}: give `{factor}` either in params or in `factors`")
    for factor in factor_names(config):
        if factor in RESERVED:
            raise no(f"factor {factor!r} is the name of a column of the results")
    for key, count in Counter(method_id(m) for m in _grid(config)).items():
        if count > 1:
            raise no(f"{' '.join(filter(None, key))} occurs twice; give one of them another label")
    titles = [metric_title(m) for m in config.metrics]
    if twice := next((t for t in titles if titles.count(t) > 1), ""):
        raise no(f"metric title {twice!r} occurs twice")
    for table in config.published:
        if table.metric not in titles:
            raise no(f"published: metric {table.metric!r} is none of {', '.join(titles)}")
        for factor in (table.by, *table.levels):
            if factor not in ("estimator", *factor_names(config)):
                raise no(f"published: {factor!r} is neither `estimator` nor a factor of this study")
    if config.simulate and not config.simulate.scenarios:
        raise no("simulate: no scenarios")
    return config


def metric_title(metric: Metric) -> str:
    """Return a metric's short name."""
    return metric.title or metric.column


def factor_names(config: StudyConfig) -> tuple[str, ...]:
    """Return the names of the study's factors: columns of its tables between filter and configuration."""
    return tuple(dict.fromkeys([*config.factors, *(name for e in config.estimators for name in e.factors)]))


def _levels(config: StudyConfig, entry: Estimators) -> dict[str, list[Level]]:
    """Return the levels of every factor that an estimator runs at; [""] where it is not part of one."""
    chosen = {**config.factors, **entry.factors}
    return {name: chosen.get(name) or [""] for name in factor_names(config)}


def method_id(method: Method) -> tuple[str, ...]:
    """Return the filter's label and the level of every factor, which name a method in tables."""
    return method.label, *method.levels.values()


def methods(config: StudyConfig) -> list[Method]:
    """Return every estimator × preset × parameters × factors, in the order of the configuration."""
    done: list[Method] = []
    for method in _grid(config):
        params = dict(method.params)
        for name, level in method.levels.items():
            if level:
                params |= _choice(config, method.estimator, name, level)
        done.append(msgspec.structs.replace(method, params=params))
    return done


def _grid(config: StudyConfig) -> Iterator[Method]:
    """Yield the methods before levels that are presets are looked up, which would import the estimators."""
    for entry in config.estimators:
        axes = {k: v if isinstance(v, list) else [v] for k, v in entry.params.items()}
        varying = [k for k, v in axes.items() if len(v) > 1]
        levels = _levels(config, entry)
        for preset, values in itertools.product(entry.presets or [""], itertools.product(*axes.values())):
            params = dict(zip(axes, values, strict=True))
            named = [preset] if len(entry.presets) > 1 and preset else []
            label = " ".join([entry.label or entry.name, *named, *(f"{k}={params[k]}" for k in varying)])
            for chosen in itertools.product(*levels.values()):
                setting = dict(zip(levels, map(str, chosen), strict=True))
                yield Method(entry.name, label, setting, preset, params)


def _choice(config: StudyConfig, estimator: str, name: str, level: str) -> dict[str, Any]:
    """Return the parameters of a factor's level: its value, or a preset of the estimator that sets it."""
    presets_of = getattr(available().get(estimator), "presets", {})
    if name in presets_of.get(level, {}):
        return presets_of[level]
    levels = (*config.factors.get(name, ()), *(v for e in config.estimators for v in e.factors.get(name, ())))
    return {name: next(value for value in levels if str(value) == level)}


def configuration(config: StudyConfig, name: str, topic: str) -> str:
    """Return the configuration of input ``topic`` of the file called ``name``; ``all`` without rules.

    A file that no rule fits is ``other``.
    """
    for rule in config.configurations:
        if (match := re.search(rule.pattern, name)) and fnmatchcase(topic, rule.input):
            return match.expand(rule.label)
    return "other" if config.configurations else "all"


def truth(config: Recordings, name: str) -> TruthRule:
    """Return what is known about the walk in the file called ``name``."""
    return next((t for t in config.truth if re.search(t.pattern, name)), TruthRule())
