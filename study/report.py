"""The study's report: one HTML file with its tables and pictures inside, readable without a network."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from html import escape
from typing import Any

import msgspec
import polars as pl

from ..replay.metrics import BETWEEN
from ..viz.page import Html, PagePicture, number
from . import config as cfg
from . import report_tests
from .analysis import base_levels, factors, order
from .labels import label_means
from .published import extremes
from .report_tests import folded, probability, reasons


class StudyTables(msgspec.Struct, frozen=True, kw_only=True):
    """The tables of a study, and what a reader must know.

    Attributes
    ----------
    config : StudyConfig
        The resolved configuration.
    results, values, groups, comparisons, outliers, published, consistency : polars.DataFrame
        See :mod:`marcha.study.analysis`; ``results`` has one row a cell.
    labels, label_comparisons : polars.DataFrame
        See :mod:`marcha.study.labels`; empty where the study does not say ``by``.
    paired, pairs, verdicts, relations : polars.DataFrame
        See :mod:`marcha.study.pairs`.
    failures : polars.DataFrame
        Cells whose results must not be used, by method: :func:`marcha.study.analysis.failures`.
    notes : list of str
        What a reader must know before the numbers.
    """

    config: cfg.StudyConfig
    results: pl.DataFrame
    values: pl.DataFrame
    groups: pl.DataFrame
    comparisons: pl.DataFrame
    outliers: pl.DataFrame
    published: pl.DataFrame
    consistency: pl.DataFrame
    labels: pl.DataFrame
    label_comparisons: pl.DataFrame
    paired: pl.DataFrame
    pairs: pl.DataFrame
    verdicts: pl.DataFrame
    relations: pl.DataFrame
    failures: pl.DataFrame
    notes: list[str]


class ReportContents(StudyTables, frozen=True, kw_only=True):
    """Everything that the report is made of.

    Attributes
    ----------
    provenance : dict
        Versions, times, machine.
    toml : str
        The resolved configuration as its file.
    """

    provenance: dict[str, Any]
    toml: str


NEES_TITLES = {
    "nees_position_end": "position at the end",
    "nees_velocity_end": "velocity at the end",
    "nees_attitude_end": "attitude at the end",
}


def mean_sd(row: dict[str, Any] | None) -> str:
    """Return ``mean ± sd`` of a group's row, the sd with the decimals of the mean."""
    if row is None or not row["n"]:
        return "–"
    text = number(row["mean"])
    if row["n"] < 2:
        return text
    decimals = len(text.partition(".")[2]) if "e" not in text else None
    sd = number(row["sd"]) if decimals is None else f"{row['sd']:.{decimals}f}"
    return f"{text} ± {sd}"


def render(contents: ReportContents, pictures: Sequence[PagePicture]) -> str:
    """Return the report as one HTML page."""
    html = Html()
    _introduction(html, contents)
    levels = order(contents.values, contents.config)
    if len(contents.values):
        _means(html, contents, levels)
        if (
            any(len(levels[n]) > 1 for n in cfg.factor_names(contents.config))
            or contents.values["clipped"].n_unique() > 1
        ):
            _methods(html, contents, levels)
        for title, section in (("Box plots", "box"), ("Tracks", "tracks"), ("Run time", "run time")):
            _gallery(html, pictures, title, section)
        if len(contents.labels):
            _labels(html, contents, levels)
        if len(contents.consistency):
            _consistency(html, contents, pictures)
        _normality(html, contents, pictures)
        report_tests.paired(html, contents)
        if len(contents.relations) or contents.config.verdicts:
            report_tests.source(html, contents)
        report_tests.comparisons(html, contents)
        _outliers(html, contents)
    _origin(html, contents)
    return html.page(contents.config.title)


def _introduction(html: Html, contents: ReportContents) -> None:
    results = contents.results
    if contents.config.description:
        html.text(contents.config.description)
    names = cfg.factor_names(contents.config)
    walks, clipped = results["recording"].n_unique(), results.filter("clipped")["recording"].n_unique()
    done = results.filter(pl.col("status") == "ok")
    html.text(
        f"{_count(walks, 'recording')}, {_count(results['filter'].n_unique(), 'filter')}, "
        f"{''.join(_count(results.filter(pl.col(n) != '')[n].n_unique(), 'level') + f' of {n}, ' for n in names)}"
        f"{_count(len(done), 'finished cell')}, {len(results) - len(done)} failed; "
        f"{_count(clipped, 'recording')} with clipped inputs. "
        f"A cell is one filter{' at one level of each factor' if names else ''} on one input of one recording."
    )
    html.warning(contents.notes)
    if len(contents.failures):
        of = factors(contents.config)
        html.heading("Failed cells")
        html.text("Runs whose results must not be used are in no mean, no test and no picture.", "note")
        rows = [
            [*(escape(r[f]) for f in of), f"{r['failed']} of {r['cells']}", escape(r["reasons"])]
            for r in contents.failures.iter_rows(named=True)
        ]
        folded(html, f"{contents.failures['failed'].sum()} cells", [*of, "failed", "why"], rows, len(of) + 2)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _lookup(contents: ReportContents, subset: str = "all") -> dict[tuple[str, ...], dict[str, Any]]:
    """Return the groups of a subset by metric, filter, levels of the factors and configuration."""
    part = contents.groups.filter(pl.col("subset") == subset)
    keys = ("metric", *factors(contents.config))
    return {tuple(r[k] for k in keys): r for r in part.iter_rows(named=True)}


def _combinations(contents: ReportContents, levels: dict[str, list[str]]) -> list[tuple[str, ...]]:
    """Return every filter with every level of every factor."""
    return list(itertools.product(*(levels[f] for f in ("filter", *cfg.factor_names(contents.config)))))


def _levels_of(label: str, base: dict[str, str], config: cfg.StudyConfig) -> tuple[str, ...]:
    """Return where a filter stands among others: at the first level of the factors that it is part of."""
    for method in cfg.methods(config):
        if method.label == label and all(method.levels[f] in (level, "") for f, level in base.items()):
            return tuple(method.levels.values())
    return tuple(base.values())


def _means(html: Html, contents: ReportContents, levels: dict[str, list[str]]) -> None:
    html.section("Means by filter and configuration")
    base = base_levels(levels, contents.config)
    entries_of = _lookup(contents)
    levels_of = {name: _levels_of(name, base, contents.config) for name in levels["filter"]}
    shares = {
        (r["configuration"],): r["share"]
        for r in contents.results.group_by("configuration")
        .agg(share=pl.col("clipped").mean())
        .iter_rows(named=True)
    }
    beside = {
        (r["metric"], *(r[f] for f in factors(contents.config))): r["published"]
        for r in contents.published.filter(pl.col("by") == "estimator").iter_rows(named=True)
    }
    clipped = ", ".join(
        f"{c} ({100 * shares[(c,)]:.0f} %)" for c in levels["configuration"] if shares.get((c,))
    )
    html.text(
        "Mean ± standard deviation (n) without outliers"
        + "".join(f"; {name} {level}" for name, level in base.items() if level)
        + (f". Inputs that reached their full scale, by configuration: {clipped}." if clipped else ".")
    )
    for metric in contents.config.metrics:
        title = cfg.metric_title(metric)
        if not any(k[0] == title for k in entries_of):
            continue
        tables = [t for t in contents.config.published if t.metric == title and t.by == "estimator"]
        html.heading(f"{title} ({metric.unit})" if metric.unit else title)
        rows: list[list[str]] = []
        for name in levels["filter"]:
            row = [escape(name)]
            for c in levels["configuration"]:
                group = entries_of.get((title, name, *levels_of[name], c))
                n = f' <span class="note">({group["n"]})</span>' if group else ""
                row.append(mean_sd(group) + n)
            rows.append([*row, mean_sd(entries_of.get((title, name, *levels_of[name], "")))])
            published = [beside.get((title, name, *levels_of[name], c)) for c in levels["configuration"]]
            if any(v is not None for v in published):
                cells = [f"@published {number(v, 4)}" for v in published]
                rows.append(["@published published", *cells, "@published "])
        html.table(["filter", *levels["configuration"], "all"], rows)
        for table in tables:
            html.text(f"Published: {'. '.join(t for t in (table.origin, table.note) if t)}", "note")
    extremes(html, contents.published)
    for name in base:
        if (contents.published["by"] == name).any():
            _published_levels(html, contents, name)


def _published_levels(html: Html, contents: ReportContents, factor: str) -> None:
    part = contents.published.filter(pl.col("by") == factor)
    html.heading(f"Levels of {factor}, beside the published means")
    of = factors(contents.config)
    rows = []
    for r in part.iter_rows(named=True):
        measured = {"n": r["n"], "mean": r["measured"], "sd": r["measured_sd"]}
        published = {
            "n": 2 if r["published_sd"] is not None else 1,
            "mean": r["published"],
            "sd": r["published_sd"],
        }
        rows.append(
            [
                *(escape(r[f]) for f in of),
                escape(f"{r['metric']} ({r['unit']})"),
                mean_sd(measured),
                str(r["n"]),
                f"@published {mean_sd(published)}",
            ]
        )
    html.table([*of, "metric", "measured", "n", "published"], rows, len(of) + 1)
    for note in dict.fromkeys(part["note"].to_list()):
        if note:
            html.text(note, "note")


def _methods(html: Html, contents: ReportContents, levels: dict[str, list[str]]) -> None:
    by = ("filter", *cfg.factor_names(contents.config))
    html.section(f"Every {' and '.join(by)}, clipped inputs apart")
    html.text(
        "Mean ± standard deviation over all configurations. An input is clipped where a sensor reached its "
        "full scale: "
        "what it did beyond is not in the data, so its errors are not the filter's alone."
    )
    titles = [cfg.metric_title(m) for m in contents.config.metrics]
    units = {cfg.metric_title(m): m.unit for m in contents.config.metrics}
    subsets = [s for s in ("unclipped", "clipped") if (contents.groups["subset"] == s).any()] or ["all"]
    rows: list[list[str]] = []
    for subset in subsets:
        entries_of = _lookup(contents, subset)
        body: list[list[str]] = []
        for method in _combinations(contents, levels):
            entries = [entries_of.get((t, *method, "")) for t in titles]
            if any(entries):
                n = max(e["n"] for e in entries if e)
                body.append([*map(escape, method), *map(mean_sd, entries), str(n)])
        if body:
            rows += [[f"{subset} inputs"], *body]
    head = [f"{t} ({units[t]})" if units[t] else t for t in titles]
    html.table([*by, *head, "n"], rows, len(by))


def _gallery(html: Html, pictures: Sequence[PagePicture], title: str, section: str) -> None:
    pictures = [p for p in pictures if p.section == section]
    if pictures:
        html.section(title)
        if section == "box":
            html.text(
                "Box: quartiles and median; whiskers: last value within 1.5 interquartile ranges; diamond: "
                "mean; "
                "dots: single values (all of them in groups below 20; groups below 5 have no box). Outliers "
                "of the sigma rule are left out."
            )
        html.pictures(pictures)


def _consistency(html: Html, contents: ReportContents, pictures: Sequence[PagePicture]) -> None:
    html.section("Consistency of the filters' own covariance")
    html.text(
        "NEES: the squared error at the end of the walk in units of the filter's own standard deviations (3 "
        "on average in space). Its mean over independent walks lies in the interval if "
        "the filter knows how wrong it is; above it is too sure, below it too careful."
    )
    table = contents.consistency
    if table["clipped"].any():
        html.text(
            "Clipped inputs stand apart: what a sensor did beyond its full scale is in no model, so there no "
            "filter can be consistent, and every error counts against it.",
            "note",
        )
    levels, of = order(table, contents.config), factors(contents.config)
    for (metric,), errors in table.group_by("metric", maintain_order=True):
        html.heading(f"{NEES_TITLES.get(str(metric), str(metric))}: mean NEES")
        rows: list[list[str]] = []
        for clipped, title in ((False, "unclipped inputs"), (True, "clipped inputs")):
            part = errors.filter(pl.col("clipped") == clipped)
            if not len(part):
                continue
            shown = [c for c in levels["configuration"] if c and c in part["configuration"]]
            shown.append("")
            rows_of = {tuple(r[f] for f in of): r for r in part.iter_rows(named=True)}
            rows.append([title])
            rows.append([*of[:-1], *(escape(c) or "all" for c in shown)])
            for method in _combinations(contents, levels):
                entries = [rows_of.get((*method, c)) for c in shown]
                if any(entries):
                    rows.append([*map(escape, method), *map(_verdict, entries)])
            limits = [next(r for r in rows_of.values() if r["configuration"] == c) for c in shown]
            rows.append(
                [
                    "@note consistent within",
                    *[""] * (len(of) - 2),
                    *(f"@note {number(r['low'])} … {number(r['high'])} ({r['n']})" for r in limits),
                ]
            )
        width = max(len(r) for r in rows)
        html.table(
            [""] * width, [r if len(r) == 1 else [*r, *[""] * (width - len(r))] for r in rows], len(of) - 1
        )
    html.pictures(p for p in pictures if p.section == "consistency")


def _verdict(row: dict[str, Any] | None) -> str:
    """Return a mean NEES with its verdict; red where the filter is too sure."""
    if row is None:
        return "–"
    if row["verdict"] == "consistent":
        return number(row["mean"])
    mark = "@differs " if row["verdict"] == "too sure" else ""
    return f"{mark}{number(row['mean'])} {row['verdict']}"


def _normality(html: Html, contents: ReportContents, pictures: Sequence[PagePicture]) -> None:
    html.section("Normality")
    level = 1 - contents.config.statistics.confidence
    tested = contents.groups.filter(
        (pl.col("subset") == "all") & (pl.col("configuration") != "") & (pl.col("filter") != "")
    )
    html.text(
        f"Shapiro-Wilk for every filter × configuration. Below p = {level:.2f} the values are hardly normal: "
        "read the "
        "rank test beside Welch's."
    )
    done = tested.filter(pl.col("shapiro_p").is_finite())
    if len(done) < len(tested):
        html.text(
            f"{len(tested) - len(done)} of {len(tested)} groups are not tested: {reasons(tested)}.", "note"
        )
    if len(done):
        of = factors(contents.config)
        rows = [
            [
                escape(r["metric"]),
                *(escape(r[f]) for f in of),
                str(r["n"]),
                number(r["shapiro_w"], 4),
                ("@differs " if r["shapiro_p"] < level else "") + probability(r["shapiro_p"]),
            ]
            for r in done.iter_rows(named=True)
        ]
        head = ["metric", *of, "n", "W", "p"]
        folded(html, f"{len(rows)} groups", head, rows, len(of) + 1)
    html.pictures(p for p in pictures if p.section == "qq")


def _labels(html: Html, contents: ReportContents, levels: dict[str, list[str]]) -> None:
    by, level = contents.config.by, 1 - contents.config.statistics.confidence
    of = factors(contents.config)
    html.section(f"By {by}")
    html.text(
        f"Metrics taken over all intervals of a label of the tier {by} together, and over what lies between "
        "them, under the alignment of the whole walk. Mean ± standard deviation (n), then every pair of labels "
        "within a walk: paired t test and Wilcoxon's signed-rank test, two-sided, corrected by Holm within the "
        f"method. Red: below {level:.2f} after the correction."
    )
    means = label_means(contents.labels, contents.config)
    labels = sorted(means["label"].unique(), key=lambda label: (label == BETWEEN, label))
    entries_of = {(r["metric"], *(r[f] for f in of), r["label"]): r for r in means.iter_rows(named=True)}
    for (metric, unit), pairs in contents.label_comparisons.group_by("metric", "unit", maintain_order=True):
        html.heading(f"{metric} ({unit})" if unit else str(metric))
        methods = list(itertools.product(*(levels[f] for f in of)))
        rows = []
        for method in methods:
            cells = [entries_of.get((metric, *method, label)) for label in labels]
            if any(cells):
                values = [f"{mean_sd(c)} ({c['n']})" if c else "–" for c in cells]
                rows.append([*(escape(m) for m in method), *values])
        html.table([*of, *(escape(label) for label in labels)], rows, len(of))
        body = [
            [
                escape(f"{r['a']} − {r['b']}"),
                *(escape(r[f]) for f in of),
                str(r["n"]),
                f"{number(r['difference'])} ({number(r['difference_low'])} … {number(r['difference_high'])})",
                number(r["effect"]),
                ("@differs " if r["t_p_holm"] < level else "") + probability(r["t_p_holm"]),
                ("@differs " if r["rank_p_holm"] < level else "") + probability(r["rank_p_holm"]),
            ]
            for r in pairs.iter_rows(named=True)
        ]
        head = ["pair", *of, "n", "difference", "d", "t p (Holm)", "Wilcoxon p (Holm)"]
        folded(html, f"{len(body)} pairs", head, body, len(of) + 1)


def _outliers(html: Html, contents: ReportContents) -> None:
    html.section("Outliers")
    sigma = contents.config.statistics.outlier_sigma
    if sigma == 0:
        html.text("No value is left out: the rule is switched off.")
        return
    count = len(contents.outliers)
    html.text(
        f"{count} of {len(contents.values)} values lie more than {sigma:g} standard deviations from the mean "
        f"of their {' × '.join(factors(contents.config))} and are left out of means, plots and tests. "
        f"Among n values none can lie beyond (n − 1)/√n, so the rule needs {_least(sigma)} values to strike."
    )
    if count:
        head = ["metric", *factors(contents.config), "recording", "input", "value"]
        rows = [
            [*(escape(str(r[c])) for c in head[:-1]), f"{number(r['value'])} {escape(r['unit'])}"]
            for r in contents.outliers.iter_rows(named=True)
        ]
        folded(html, f"{count} values", head, rows, len(head) - 1)


def _least(sigma: float) -> int:
    n = 2
    while (n - 1) / math.sqrt(n) <= sigma:
        n += 1
    return n


def _origin(html: Html, contents: ReportContents) -> None:
    html.section("Provenance")
    rows = [[escape(k), escape(str(v))] for k, v in contents.provenance.items()]
    html.table(["", ""], rows, 2)
    html.parts.append(
        f"<details><summary>Configuration</summary><pre>{escape(contents.toml)}</pre></details>"
    )
