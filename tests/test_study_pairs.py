"""Comparisons over the same walks, a publication's verdicts and relations, and runs that must not be used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import simulate as sim
from marcha.study import StudyConfig, gallery, pairs, run_study
from marcha.study import config as cfg
from marcha.study.statistics import paired

CONFIG = StudyConfig(
    estimators=[cfg.Estimators(name="foot.9iez", label="A"), cfg.Estimators(name="foot.ukf", label="B")],
    metrics=[cfg.Metric(column="closure_percent", title="EP", unit="%")],
    published=[
        cfg.Published(metric="EP", origin="made up", table="5", rows={"A": {"C0": 1.0}, "B": {"C0": 2.0}})
    ],
    verdicts=[cfg.Verdict(metric="EP", smallest=["A C0"])],
)


def frame(a: np.ndarray, b: np.ndarray, clipped: np.ndarray) -> pl.DataFrame:
    """Return values of the filters A and B on the same walks."""
    walks = [f"walk{i}" for i in range(len(a))]
    parts = [
        pl.DataFrame({"filter": label, "recording": walks, "clipped": clipped, "value": values})
        for label, values in (("A", a), ("B", b))
    ]
    return pl.concat(parts).with_columns(
        metric=pl.lit("EP"),
        unit=pl.lit("%"),
        configuration=pl.lit("C0"),
        input=pl.lit("/imu"),
        outlier=pl.lit(False),
    )


@given(seed=st.integers(0, 500), n=st.integers(5, 40), shift=st.floats(-2.0, 2.0))
def test_the_paired_tests_are_pingouins(seed: int, n: int, shift: float) -> None:
    pingouin = pytest.importorskip("pingouin")
    rng = np.random.default_rng(seed)
    a = rng.normal(size=n)
    b = a + shift + 0.5 * rng.normal(size=n)
    found = paired(a, b)
    test = pingouin.ttest(a, b, paired=True).iloc[0]
    rank = pingouin.wilcoxon(a, b).iloc[0]
    low, high = next(test[c] for c in test.index if str(c).startswith("CI95"))
    p = next(c for c in test.index if str(c).startswith("p"))
    assert found.t == pytest.approx(test["T"])
    assert found.t_p == pytest.approx(test[p])
    # pingouin rounds its interval to two decimals.
    assert (found.difference_low, found.difference_high) == pytest.approx((low, high), abs=6e-3)
    assert found.rank_p == pytest.approx(rank[next(c for c in rank.index if str(c).startswith("p"))])
    assert found.rank_effect == pytest.approx(rank["RBC"])


def test_the_interval_of_the_effect_covers_it_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(400):
        difference = 0.8 + rng.normal(size=12)
        found = paired(difference, np.zeros(12))
        inside += found.effect_low <= 0.8 <= found.effect_high
    assert 0.91 < inside / 400 < 0.985


def test_a_difference_within_walks_is_found_where_walks_differ_more() -> None:
    """The walks' own spread hides it from Welch's test, not from the paired one; clipped walks stand apart."""
    rng = np.random.default_rng(3)
    walk = rng.uniform(0.2, 3.0, 24)
    clipped = np.arange(24) % 2 == 0
    b = walk + 0.1 + 0.05 * rng.normal(size=24) + 5.0 * clipped
    values = frame(walk, b, clipped)
    found = pairs.paired_comparisons(values, CONFIG)
    assert found["subset"].to_list() == ["unclipped", "clipped"]
    (apart, ceiling) = found.iter_rows(named=True)
    assert (apart["n"], ceiling["n"]) == (12, 12)
    assert apart["t_p_holm"] < 0.01
    assert -0.16 < apart["difference"] < -0.05
    assert -5.2 < ceiling["difference"] < -5.0
    only = values.filter(~pl.col("clipped"))
    (welch,) = (
        pairs.all_pairs(_two_configurations(only), CONFIG)
        .filter(pl.col("a") != pl.col("b"))
        .head(1)
        .to_dicts()
    )
    assert welch["p"] > 0.3


def _two_configurations(values: pl.DataFrame) -> pl.DataFrame:
    return pl.concat([values, values.with_columns(configuration=pl.lit("C1"), value=pl.col("value") + 9.0)])


def test_every_combination_is_compared_with_every_other_and_the_smallest_named() -> None:
    rng = np.random.default_rng(5)
    a = 1.0 + 0.1 * rng.normal(size=15)
    b = 3.0 + 0.1 * rng.normal(size=15)
    values = _two_configurations(frame(a, b, np.zeros(15, bool)))
    family = pairs.all_pairs(values, CONFIG)
    assert len(family) == 4 * 3 // 2
    (verdict,) = pairs.verdicts(values, family, CONFIG).to_dicts()
    assert (verdict["smallest"], verdict["equal"], verdict["same"]) == ("A C0", "", "yes")
    level = _two_configurations(frame(a, a + 0.01 * rng.normal(size=15), np.zeros(15, bool)))
    (verdict,) = pairs.verdicts(level, pairs.all_pairs(level, CONFIG), CONFIG).to_dicts()
    assert {verdict["smallest"], verdict["equal"]} == {"A C0", "B C0"}
    assert verdict["same"] == "no"


def test_too_few_walks_name_the_smallest_mean_and_say_that_nothing_was_tested() -> None:
    values = _two_configurations(frame(np.array([1.0, 1.2]), np.array([3.0, 3.1]), np.zeros(2, bool)))
    (verdict,) = pairs.verdicts(values, pairs.all_pairs(values, CONFIG), CONFIG).to_dicts()
    assert (verdict["smallest"], verdict["equal"], verdict["same"]) == ("A C0", "", "")
    assert verdict["note"] == "not tested: 2 walks a combination at most, 3 needed"


@pytest.mark.parametrize(("shift", "wanted"), [(1.0, "yes"), (-1.0, "no"), (0.0, "open")])
def test_a_published_relation_reproduces_or_not(shift: float, wanted: str) -> None:
    """Published: A has half the error of B."""
    rng = np.random.default_rng(11)
    a = 2.0 + 0.1 * rng.normal(size=12)
    values = frame(a, a + shift + 0.1 * rng.normal(size=12), np.zeros(12, bool))
    (row,) = pairs.relations(values, CONFIG).to_dicts()
    assert row["reproduces"] == wanted
    assert row["published_ratio"] == 0.5
    assert row["measured_ratio"] == pytest.approx(2.0 / (2.0 + shift), rel=0.1)


def _recording(path: Path, rows: dict[str, np.ndarray], walk: Any) -> None:
    t_ns = walk.t_ns[: len(rows["acc"])]
    table = pl.DataFrame({"t_ns": t_ns})
    for name in ("acc", "gyr"):
        table = table.with_columns(**{f"{name}_{x}": rows[name][:, i] for i, x in enumerate("xyz")})
    with mr.create(path) as out:
        out.add_table("/foot/imu", "sensor_msgs/msg/Imu", table)


def test_vanished_diverged_and_good_walks_are_reported_as_what_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One walk whose only rest comes after it, one without a stance, one that cannot be read, two good ones."""
    monkeypatch.setattr(gallery, "drawings", lambda *_: [])
    folder = tmp_path / "walks"
    folder.mkdir()
    for seed in (1, 2):
        walk = sim.walk("rectangle", seed=seed, length_m=12.0)
        acc, gyr = walk.measured()
        _recording(folder / f"good{seed}.mcap", {"acc": acc, "gyr": gyr}, walk)
    begin = 180
    tail = np.repeat([20], 400)
    late = np.concatenate([np.arange(begin, len(acc)), tail])[: len(acc)]
    _recording(folder / "vanished.mcap", {"acc": acc[late], "gyr": gyr[late]}, walk)
    restless = gyr.copy()
    restless[260:] += 3.0 * np.random.default_rng(0).normal(size=restless[260:].shape)
    _recording(folder / "diverged.mcap", {"acc": acc, "gyr": restless}, walk)
    (folder / "cut.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\0" * 40)
    config = StudyConfig(
        recordings=cfg.Recordings(files=["*.mcap"]),
        estimators=[cfg.Estimators(name="foot.9iez", label="9IEZ", presets=["published"])],
        metrics=[cfg.Metric(column="closure_m", title="EP", unit="m")],
    )
    done = run_study(config, tmp_path / "out", data=folder, workers=1)
    state = {r["recording"].removesuffix(".mcap"): r for r in done.results.iter_rows(named=True)}
    assert {k for k, r in state.items() if r["status"] == "ok"} == {"good1", "good2"}
    assert "what is estimated is not the walk" in state["vanished"]["error"]
    assert "stance" in state["diverged"]["error"] or "still" in state["diverged"]["error"]
    assert state["cut"]["error"]
    assert state["vanished"].get("closure_m") is None  # no error, least of all one of 0
    (group,) = done.groups.filter(filter="9IEZ", configuration="").to_dicts()[:1]
    assert group["n"] == 2
    assert done.cells_failed == 3
    assert done.failures["failed"].sum() == 3
    assert (
        "late_start" in (tmp_path / "out/results.csv").read_text()
        or "not the walk" in state["vanished"]["error"]
    )
    report = (tmp_path / "out/report.html").read_text()
    assert "Failed cells" in report
    assert "3 of 5" in report
