"""The study's statistics against published examples, closed forms and brute force."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.study.statistics import (
    GroupComparison,
    compare,
    corrected,
    hedges_g,
    holm,
    normal_quantiles,
    outlier_mask,
    paired,
    summarize,
)

# Student's sleep data (Cushny and Peebles 1905), as in R's datasets::sleep.
SLEEP_1 = [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]
SLEEP_2 = [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]
# Weights of 11 men, the example of Shapiro and Wilk (1965), section 4.
WEIGHTS = [148, 154, 158, 160, 161, 162, 166, 170, 182, 195, 236]


def test_holm_gives_the_textbook_example() -> None:
    # R: p.adjust(c(.01, .04, .03, .005), "holm")
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_holm_leaves_missing_tests_out_of_the_family() -> None:
    adjusted = holm([0.01, math.nan, 0.04])
    assert adjusted[[0, 2]] == pytest.approx([0.02, 0.04])
    assert math.isnan(adjusted[1])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_keeps_the_order_and_lies_between_raw_and_bonferroni(p: list[float]) -> None:
    raw, adjusted = np.array(p), holm(p)
    assert (adjusted >= raw).all()
    assert (adjusted <= np.minimum(1, raw * len(raw)) + 1e-15).all()
    assert (np.diff(adjusted[np.argsort(raw, kind="stable")]) >= 0).all()


def test_welch_gives_rs_result_for_the_sleep_data() -> None:
    # R: t.test(extra ~ group, data = sleep): t = -1.8608, df = 17.776, p = 0.07939, CI -3.3654832 0.2054832
    c = compare(SLEEP_1, SLEEP_2)
    assert (c.welch_t, c.welch_df, c.welch_p) == pytest.approx((-1.8608, 17.776, 0.07939), rel=1e-4)
    assert (c.difference_low, c.difference_high) == pytest.approx((-3.3654832, 0.2054832), rel=1e-6)


def test_hedges_g_is_cohens_d_with_the_exact_correction() -> None:
    # R: effsize::cohen.d gives d = -0.8321811; J(18) = Γ(9) / (3 Γ(8.5)), worked out by hand.
    j = 40320 / (3 * math.gamma(8.5))
    assert hedges_g(SLEEP_1, SLEEP_2)[0] == pytest.approx(-0.8321811 * j, rel=1e-6)


def test_hedges_interval_has_the_observed_t_in_its_tails() -> None:
    g, low, high = hedges_g(SLEEP_1, SLEEP_2)
    rng = np.random.default_rng(1)
    n, k, m = 10, 10, 18
    root, t_observed = math.sqrt(1 / n + 1 / k), -1.8608
    j = 40320 / (3 * math.gamma(8.5))
    z, chi = rng.standard_normal(400_000), np.sqrt(rng.chisquare(m, 400_000) / m)
    beyond = [np.mean((z + bound / j / root) / chi > t_observed) for bound in (low, high)]
    assert beyond == pytest.approx([0.025, 0.975], abs=0.001)
    assert low < g < high


def test_mann_whitney_of_two_apart_samples_of_three_is_one_in_ten() -> None:
    # 2 of the 20 ways to order them are as extreme.
    assert compare([1.0, 2.0, 3.0], [4.0, 5.0, 6.0]).rank_p == pytest.approx(0.1)


def test_brunner_munzel_gives_the_papers_example() -> None:
    # Brunner and Munzel (2000), pain scores of 14 and 11 patients: W = 3.1375, p = 0.0057862.
    a = [1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 2, 4, 1, 1]
    b = [3, 3, 4, 3, 1, 2, 3, 1, 1, 5, 4]
    assert compare(a, b, nonparametric="brunner-munzel").rank_p == pytest.approx(0.0057862, rel=1e-4)


def test_shapiro_gives_the_papers_example() -> None:
    group = summarize(WEIGHTS, sigma=0)
    assert group.shapiro_w == pytest.approx(0.79, abs=0.005)
    assert group.shapiro_p == pytest.approx(0.0067, abs=0.0003)


def test_eleven_values_can_hold_an_outlier_and_ten_cannot() -> None:
    # One value among n equal ones lies (n − 1)/√n standard deviations out: 3.015 for 11, 2.846 for 10.
    assert outlier_mask([0.0] * 10 + [1.0], 3).tolist() == [False] * 10 + [True]
    assert not outlier_mask([0.0] * 9 + [1.0], 3).any()


def test_outliers_are_counted_and_left_out_of_the_mean() -> None:
    group = summarize([1.0] * 10 + [2.0] * 10 + [100.0, math.nan], sigma=3)
    assert (group.n, group.outliers, group.missing, group.mean) == (20, 1, 1, 1.5)


def test_too_few_values_are_said_and_not_tested() -> None:
    group, pair = summarize([1.0, 2.0]), compare([1.0, 2.0], [3.0, 4.0, 5.0])
    assert math.isnan(group.shapiro_p)
    assert "2 values, 3 needed" in group.note
    assert math.isnan(pair.welch_p)
    assert pair.note == "not tested: 2 and 3 values, 3 each needed"


def test_equal_values_are_said_and_not_tested() -> None:
    assert "equal" in summarize([2.0, 2.0, 2.0, 2.0]).note
    assert "no spread" in compare([2.0] * 4, [3.0] * 4).note


def test_a_family_is_corrected_test_by_test() -> None:
    family = [
        GroupComparison(5, 5, welch_p=0.01, rank_p=0.04),
        GroupComparison(5, 5, welch_p=0.03, rank_p=0.02),
    ]
    done = corrected(family)
    assert [c.welch_p_holm for c in done] == pytest.approx([0.02, 0.03])
    assert [c.rank_p_holm for c in done] == pytest.approx([0.04, 0.04])


@given(st.integers(3, 40), st.integers(3, 40), st.floats(-2, 2), st.integers(0, 1000))
def test_a_comparison_turned_round_changes_signs_only(n: int, k: int, shift: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 1, n), rng.normal(shift, 2, k)
    one, other = compare(a, b), compare(b, a)
    assert one.welch_p == pytest.approx(other.welch_p)
    assert one.rank_p == pytest.approx(other.rank_p)
    assert (one.hedges_g, one.hedges_low) == pytest.approx(
        (-other.hedges_g, -other.hedges_high), rel=1e-4, abs=1e-6
    )


@pytest.mark.parametrize("count", [3, 30])
def test_normal_quantiles_are_scipys(count: int) -> None:
    from scipy import stats

    expected: Any = stats.probplot(np.arange(float(count)), fit=False)
    assert normal_quantiles(count) == pytest.approx(expected[0], rel=1e-12, abs=1e-12)


def test_a_paired_comparison_of_the_sleep_data() -> None:
    found = paired(SLEEP_1, SLEEP_2)  # R: t.test(extra ~ group, paired = TRUE)
    assert found.t == pytest.approx(-4.0621, abs=5e-5)
    assert found.t_p == pytest.approx(0.002833, abs=5e-7)
    assert (found.difference_low, found.difference_high) == pytest.approx((-2.4598858, -0.7001142), abs=1e-6)
    assert found.effect == pytest.approx(-4.0621 / math.sqrt(10), abs=1e-4)
    assert found.rank_p == pytest.approx(0.003906, abs=0.006)  # nine pairs differ, with ties


def test_what_cannot_be_paired_is_said() -> None:
    assert paired(SLEEP_1[:2], SLEEP_2[:2]).note.startswith("not tested: 2 pairs")
    assert "no spread" in paired([1.0, 2.0, 3.0], [2.0, 3.0, 4.0]).note
