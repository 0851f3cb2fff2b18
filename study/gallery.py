"""Which figures a study has, and having them drawn by the processes that are there.

What they look like is in :mod:`~marcha.study.figures`, which only those who draw import.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import polars as pl

from ..viz.page import PagePicture
from . import config as cfg
from .analysis import at_base, base_levels, order
from .cells import StudyCell
from .executors import Executor


class Drawing(msgspec.Struct, frozen=True):
    """A figure to be drawn, in any process.

    Attributes
    ----------
    name, section, caption : str
        See :class:`~marcha.viz.page.PagePicture`.
    function : str
        Name of the function of :mod:`~marcha.study.figures` that returns it, or None.
    arguments : tuple
        Its arguments.
    """

    name: str
    section: str
    caption: str
    function: str
    arguments: tuple[Any, ...]


def drawings(
    frame: pl.DataFrame, nees: pl.DataFrame, cells: Sequence[StudyCell], config: cfg.StudyConfig
) -> list[Drawing]:
    """Return all that the study has to show, in the order of the report; see :func:`draw`."""
    levels = order(frame, config)
    base = base_levels(levels, config)
    fixed = "".join(f", {name} {level}" for name, level in base.items() if level)
    drawn: list[Drawing] = []
    for metric in config.metrics:
        title = cfg.metric_title(metric)
        whole = frame.filter((pl.col("metric") == title) & pl.col("value").is_finite())
        part = whole.filter(*at_base(base))
        if not len(part):
            continue
        stem = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
        section = "run time" if metric.column == "run_time_s" else "box"
        for factor in ("filter", "configuration"):
            if len(levels[factor]) > 1:
                caption = f"{title} by {factor}, all others together{fixed}."
                arguments = (part, config, factor, metric.log)
                drawn.append(Drawing(f"box-{stem}-{factor}", section, caption, "box_by", arguments))
        if len(levels["filter"]) > 1 and len(levels["configuration"]) > 1:
            caption = f"{title} by configuration and filter{fixed}."
            arguments = (part, config, metric.log)
            drawn.append(Drawing(f"box-{stem}-both", section, caption, "box_by_both", arguments))
        if section == "run time":
            continue
        for name in base:
            if len(levels[name]) > 1:
                caption = f"{title} by {name}, all filters and configurations together."
                arguments = (whole, config, name, metric.log)
                drawn.append(Drawing(f"box-{stem}-{name}", section, caption, "box_by", arguments))
        caption = f"{title}: ordered values against normal quantiles; on the line they are normal{fixed}."
        drawn.append(Drawing(f"qq-{stem}", "qq", caption, "qq", (part, config)))
    own = [c for c in cells if all(c.levels[name] in (level, "") for name, level in base.items())]
    if config.tracks and own:
        caption = f"Tracks seen from above: start at the cross, dots where they end{fixed}."
        if any(c.clipped for c in own):
            caption += " Dashed: clipped input."
        drawn.append(Drawing("tracks", "tracks", caption, "tracks", (own, config)))
    drawn += _levels(frame, cells, config)
    drawn += _walk_by_walk(own, config)
    single = nees.filter(pl.col("configuration") != "", *at_base(base))
    if len(single):
        caption = f"Mean NEES over the walks{fixed}; above the band a filter is too sure of itself."
        drawn.append(Drawing("consistency", "consistency", caption, "consistency", (single, config)))
    return drawn


def _levels(frame: pl.DataFrame, cells: Sequence[StudyCell], config: cfg.StudyConfig) -> list[Drawing]:
    """Return figures of the levels of a factor against each other, where one filter is held fixed.

    That is where a published table does so (filter, levels and configurations are the table's), or where the study
    has one filter only.
    """
    labels = {m.label for m in cfg.methods(config)}
    chosen: dict[tuple[str, str], tuple[list[str], list[str]]] = {}
    for table in config.published:
        if table.by != "estimator" and table.estimator in labels:
            columns = list(dict.fromkeys(c for row in table.rows.values() for c in row))
            chosen.setdefault((table.estimator, table.by), (list(table.rows), columns))
    if not chosen and len(labels) == 1:
        names = frame["configuration"].unique().to_list()
        for factor in cfg.factor_names(config):
            chosen[next(iter(labels)), factor] = (frame[factor].unique().to_list(), names)
    drawn: list[Drawing] = []
    for (label, factor), (levels, configurations) in chosen.items():
        part = frame.filter(
            pl.col("filter") == label,
            pl.col(factor).is_in(levels),
            pl.col("configuration").is_in(configurations),
            pl.col("value").is_finite(),
        )
        if part[factor].n_unique() < 2:
            continue
        own = [
            c
            for c in cells
            if c.label == label and c.levels[factor] in levels and c.configuration in configurations
        ]
        stem = re.sub(r"[^a-z0-9]+", "-", f"{factor}-{label}".lower()).strip("-")
        where = f"{label}, {', '.join(sorted(configurations))}"
        caption = f"{where}: every metric by {factor} (mean: diamond; below 20 values every value)."
        drawn.append(Drawing(f"levels-{stem}", "box", caption, "level_boxes", (part, config, factor)))
        if config.tracks and own:
            caption = f"{where}: tracks by {factor}, start at the cross, dots where they end."
            drawn.append(
                Drawing(f"level-tracks-{stem}", "tracks", caption, "level_tracks", (own, config, factor))
            )
    return drawn


def _walk_by_walk(cells: Sequence[StudyCell], config: cfg.StudyConfig) -> list[Drawing]:
    """Return figures walk by walk where the study asks for signed differences, one a filter."""
    wanted = [
        (column, unit)
        for column, difference, unit in (
            ("steps", "steps_difference", "steps"),
            ("distance_m", "distance_difference_m", "m"),
        )
        if any(m.column == difference for m in config.metrics)
    ]
    drawn: list[Drawing] = []
    for label in dict.fromkeys(c.label for c in cells) if wanted else ():
        own = [c for c in cells if c.label == label]
        stem = re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-")
        for column, unit in wanted:
            caption = f"{label}: estimated and true {column.removesuffix('_m')} of every walk, and their difference."
            arguments = (own, config, column, unit)
            drawn.append(Drawing(f"walks-{column}-{stem}", "box", caption, "by_walk", arguments))
        if config.tracks:
            caption = f"{label}: local tracks, six walks a panel: start at the cross, dots where they end."
            drawn.append(Drawing(f"walk-tracks-{stem}", "tracks", caption, "walk_panels", (own, config)))
    return drawn


def render(drawing: Drawing) -> PagePicture | None:
    """Draw one figure; None where there is nothing to see."""
    from . import figures

    images = figures.images(getattr(figures, drawing.function), *drawing.arguments)
    return None if images is None else PagePicture(drawing.name, drawing.section, drawing.caption, *images)


def draw(
    executor: Executor,
    values: pl.DataFrame,
    consistency: pl.DataFrame,
    cells: Sequence[StudyCell],
    config: cfg.StudyConfig,
    meanwhile: Callable[[], object] = lambda: None,
) -> list[PagePicture]:
    """Draw every figure, by the processes that are there.

    Parameters
    ----------
    executor : Executor
        Runs the drawing.
    values, consistency : polars.DataFrame
        Tables of :mod:`~marcha.study.analysis`.
    cells : sequence of StudyCell
        Their tracks are drawn.
    config : StudyConfig
        The study.
    meanwhile : callable, optional
        See :meth:`Executor.run`.
    """
    todo = drawings(values, consistency, cells, config)
    done: dict[str, PagePicture | None] = {}
    # From the end of the report, where the largest figures stand: none of them is begun last.
    for drawing, outcome in executor.run(render, todo[::-1], meanwhile):
        if isinstance(outcome, Exception):
            raise outcome
        done[drawing.name] = outcome
    return [picture for d in todo if (picture := done[d.name]) is not None]
