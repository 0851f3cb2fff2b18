"""Figures of a factor's levels against each other: figures 35 and 36 of the foot source."""

from __future__ import annotations

import numpy as np
import polars as pl
from marcha.study import figures
from marcha.study.analysis import by_number
from marcha.study.config import load
from marcha.study.gallery import drawings


def values(filters: tuple[str, ...], detectors: tuple[str, ...], metrics: tuple[str, ...]) -> pl.DataFrame:
    rng = np.random.default_rng(1)
    rows = [
        {
            "recording": f"walk{k}",
            "filter": name,
            "detector": detector,
            "configuration": configuration,
            "metric": metric,
            "unit": "%",
            "value": float(rng.uniform(1.0, 2.0)),
            "outlier": False,
            "clipped": False,
        }
        for name in filters
        for detector in detectors
        for configuration in ("C00", "C33")
        for metric in metrics
        for k in range(6)
    ]
    return pl.DataFrame(rows)


def levels_of(preset: str, frame: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Return the tables of the figures of levels that a preset has."""
    config, _ = load(preset)
    nees = pl.DataFrame(
        {"configuration": [], "detector": []}, schema={"configuration": pl.String, "detector": pl.String}
    )
    return {d.name: d.arguments[0] for d in drawings(frame, nees, [], config) if d.function == "level_boxes"}


def test_a_published_table_by_a_factor_has_its_figure() -> None:
    """Table 9: 15IEZ+ZARU on C33, both detectors of the source and no other."""
    frame = values(("9IEZ", "15IEZ+ZARU"), ("c1c2c3", "pitch", "shoe"), ("EP", "EA"))
    found = levels_of("foot-tables", frame)
    assert list(found) == ["levels-detector-15iez-zaru"]
    part = found["levels-detector-15iez-zaru"]
    assert set(part["filter"]) == {"15IEZ+ZARU"}
    assert set(part["configuration"]) == {"C33"}
    assert set(part["detector"]) == {"c1c2c3", "pitch"}
    assert part.height == 2 * 2 * 6


def test_one_filter_and_a_factor_have_one_over_all_configurations() -> None:
    frame = values(("15IEZ+ZARU",), ("c1c2c3", "pitch"), ("EP", "track RMSE"))
    (part,) = levels_of("foot-length", frame).values()
    config, _ = load("foot-length")
    drawn = figures.level_boxes(part, config, "detector")
    assert [ax.get_ylabel() for ax in drawn.axes] == ["EP (%)", "track RMSE (%)"]
    assert [t.get_text() for t in drawn.axes[0].get_xticklabels()] == ["C00", "C33"]
    means = [line for line in drawn.axes[0].lines if line.get_marker() == "D"]
    shown = np.concatenate([np.asarray(line.get_ydata(), float) for line in means])
    wanted = (
        part.filter(metric="EP")
        .group_by("configuration", "detector", maintain_order=True)
        .agg(pl.col("value").mean())
    )
    assert np.allclose(np.sort(shown), np.sort(wanted["value"].to_numpy()))


def test_a_level_alone_has_none() -> None:
    assert not levels_of("foot-length", values(("15IEZ+ZARU",), ("pitch",), ("EP",)))


def test_the_topmost_marker_is_drawn_whole() -> None:
    frame = values(("15IEZ+ZARU",), ("c1c2c3", "pitch"), ("EP",)).with_columns(
        pl.col("value") - pl.col("value").min()
    )
    config, _ = load("foot-length")
    (ax, *_) = figures.level_boxes(frame, config, "detector").axes
    assert ax.get_ylim()[0] == 0
    assert ax.get_ylim()[1] > 1.05 * np.max(frame["value"].to_numpy())


def test_correlations_near_one_have_a_scale_that_shows_them() -> None:
    frame = values(("15IEZ+ZARU",), ("c1c2c3", "pitch"), ("EP",)).with_columns(
        value=0.98 + pl.col("value") % 0.01
    )
    config, _ = load("foot-length")
    (ax, *_) = figures.level_boxes(frame, config, "detector").axes
    assert ax.get_ylim()[0] > 0.9


def test_few_walks_a_configuration_have_one_q_q_plot_together() -> None:
    frame = values(("9IEZ",), ("c1c2c3",), ("EP",)).filter(pl.col("recording").is_in(["walk0", "walk1"]))
    config, _ = load("foot-tables")
    drawn = figures.qq(frame, config)
    assert drawn is not None
    assert [ax.get_title() for ax in drawn.axes] == ["all configurations"]


def test_configurations_are_ordered_by_their_numbers() -> None:
    assert sorted(["100 m", "C10", "50 m", "C9", "10 m"], key=by_number) == [
        "10 m",
        "50 m",
        "100 m",
        "C9",
        "C10",
    ]
