"""The report's sections on tests: same walks, published relations, which means differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import polars as pl

from ..viz.page import Html, number

if TYPE_CHECKING:
    from .report import ReportContents


def probability(value: float | None) -> str:
    """Return a p value as it is written in papers."""
    if value is None or not math.isfinite(value):
        return "–"
    return "&lt; 0.001" if value < 0.001 else f"{value:.3f}"


def reasons(frame: pl.DataFrame) -> str:
    """Return why tests were not computed, the most frequent first."""
    notes = frame.filter(pl.col("note") != "")["note"].value_counts(sort=True)
    return "; ".join(f"{r['note']} ({r['count']}×)" for r in notes.head(5).iter_rows(named=True))


def folded(html: Html, title: str, head: Sequence[str], rows: list[list[str]], text_columns: int) -> None:
    """Add a table that can be folded away; open where it is short."""
    html.parts.append(f"<details{' open' if len(rows) <= 30 else ''}><summary>{escape(title)}</summary>")
    html.table(head, rows, text_columns)
    html.parts.append("</details>")


def paired(html: Html, contents: ReportContents) -> None:
    """Filters and levels of factors over the same walks."""
    table = contents.paired
    if not len(table):
        return
    level = 1 - contents.config.statistics.confidence
    html.section("Same walks: which methods differ")
    html.text(
        "Every pair of filters (and of levels of a factor) over the walks that both finished, clipped walks apart: "
        "paired t test and Wilcoxon's signed-rank test, two-sided, corrected by Holm within the family; d is the mean "
        f"difference over its standard deviation, r the rank-biserial correlation. Red: below {level:.2f} after the "
        "correction."
    )
    done = table.filter(pl.col("t_p").is_finite())
    if len(done) < len(table):
        html.text(f"{len(table) - len(done)} of {len(table)} pairs are not tested: {reasons(table)}.", "note")
    for (factor, metric), rows in done.group_by("factor", "metric", maintain_order=True):
        unit = rows["unit"][0]
        body: list[list[str]] = []
        for (subset, within), family in rows.group_by("subset", "within", maintain_order=True):
            where = escape(str(within) or "all together") + ("" if subset == "all" else f", {subset}")
            body.append([where])
            body += [
                [
                    escape(f"{r['a']} − {r['b']}"),
                    str(r["n"]),
                    f"{number(r['difference'])} ({number(r['difference_low'])} … {number(r['difference_high'])})",
                    f"{number(r['effect'])} ({number(r['effect_low'])} … {number(r['effect_high'])})",
                    number(r["rank_effect"]),
                    ("@differs " if r["t_p_holm"] < level else "") + probability(r["t_p_holm"]),
                    ("@differs " if r["rank_p_holm"] < level else "") + probability(r["rank_p_holm"]),
                ]
                for r in family.iter_rows(named=True)
            ]
        count = rows.filter((pl.col("t_p_holm") < level) | (pl.col("rank_p_holm") < level)).height
        title = f"{metric} ({unit})" if unit else str(metric)
        html.parts.append(
            f"<details><summary>Between {escape(str(factor))}s, {escape(title)}: {count} of {len(rows)} pairs "
            "differ</summary>"
        )
        html.table(["pair", "walks", "difference", "d", "r", "t p (Holm)", "Wilcoxon p (Holm)"], body)
        html.parts.append("</details>")


def source(html: Html, contents: ReportContents) -> None:
    """What the publication says, and whether it holds here."""
    html.section("Published relations")
    if contents.config.verdicts and len(contents.verdicts):
        html.text(
            "The combination of filter and configuration with the smallest mean, and those that Welch's test does not "
            "tell from it (uncorrected, as published; every pair of combinations is in pairs.csv, with Holm's "
            "correction beside)."
        )
        rows = [
            [
                escape(r["metric"]),
                f"{escape(r['smallest'])} ({number(r['mean'])})",
                escape(r["note"] or r["equal"]) or "none",
                f"@published {escape(r['published']) or '–'}",
                r["same"] or "–",
            ]
            for r in contents.verdicts.iter_rows(named=True)
        ]
        html.table(["metric", "smallest mean", "not told from it", "published", "same"], rows, 4)
    table = contents.relations
    if not len(table):
        return
    counts = {v: table.filter(pl.col("reproduces") == v).height for v in ("yes", "no", "open")}
    html.text(
        f"{len(table)} relations between rows of the published tables, over the walks that have both: {counts['yes']} "
        f"reproduce, {counts['no']} are the other way round, {counts['open']} are open (the interval of the difference "
        "holds zero, or too few walks)."
    )
    for (metric,), part in table.group_by("metric", maintain_order=True):
        rows = [
            [
                escape(f"{r['a']} / {r['b']}"),
                escape(r["configuration"]),
                f"@published {number(r['published_ratio'], 3)}",
                "–" if r["measured_ratio"] is None else number(r["measured_ratio"], 3),
                f"{number(r['difference'])} ({number(r['low'])} … {number(r['high'])})",
                str(r["n"]),
                ("@differs " if r["reproduces"] == "no" else "") + r["reproduces"],
            ]
            for r in part.iter_rows(named=True)
        ]
        head = [
            "relation",
            "configuration",
            "published ratio",
            "ratio here",
            "difference",
            "walks",
            "reproduces",
        ]
        folded(html, f"{metric}: {len(rows)} relation{'s'[: len(rows) > 1]}", head, rows, 2)


def comparisons(html: Html, contents: ReportContents) -> None:
    """Every pair of means as the source tests them."""
    statistics = contents.config.statistics
    level = 1 - statistics.confidence
    twin = {"mann-whitney": "Mann-Whitney U", "brunner-munzel": "Brunner-Munzel"}[statistics.nonparametric]
    html.section("Which means differ")
    html.text(
        f"Every pair within a family: Welch's t test and {twin}, two-sided, both corrected by Holm within "
        "the family, and "
        f"Hedges' g with its {100 * statistics.confidence:.0f} % interval. Red: below {level:.2f} after the "
        "correction. "
        "These tests treat all values as independent and pool clipped walks with others, as the source does: right "
        "between configurations, careful between filters, for which the section above has the paired tests."
    )
    table = contents.comparisons
    done = table.filter(pl.col("welch_p").is_finite())
    if len(done) < len(table):
        html.text(f"{len(table) - len(done)} of {len(table)} pairs are not tested: {reasons(table)}.", "note")
    for (factor,), part in done.group_by("factor", maintain_order=True):
        html.heading(f"Between {factor}s")
        for (metric,), rows in part.group_by("metric", maintain_order=True):
            body: list[list[str]] = []
            for (within,), family in rows.group_by("within", maintain_order=True):
                body.append([escape(str(within) or "all together")])
                for r in family.iter_rows(named=True):
                    marks = ["@differs " if p < level else "" for p in (r["welch_p_holm"], r["rank_p_holm"])]
                    body.append(
                        [
                            escape(f"{r['a']} − {r['b']}"),
                            f"{r['n_a']}, {r['n_b']}",
                            f"{number(r['difference'])} ({number(r['difference_low'])} … "
                            f"{number(r['difference_high'])})",
                            number(r["welch_t"]),
                            number(r["welch_df"]),
                            marks[0] + probability(r["welch_p_holm"]),
                            f"{number(r['hedges_g'])} ({number(r['hedges_low'])} … "
                            f"{number(r['hedges_high'])})",
                            marks[1] + probability(r["rank_p_holm"]),
                        ]
                    )
            unit = rows["unit"][0]
            title = f"{metric} ({unit})" if unit else str(metric)
            count = rows.filter(pl.col("welch_p_holm") < level).height
            head = [
                "pair",
                "n",
                f"difference{f' ({unit})' if unit else ''}",
                "t",
                "df",
                "p (Holm)",
                "Hedges' g",
                f"{twin} p (Holm)",
            ]
            html.parts.append(
                f"<details><summary>{escape(title)}: {count} of {len(rows)} pairs differ</summary>"
            )
            html.table(head, body)
            html.parts.append("</details>")
