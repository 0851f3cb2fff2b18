"""Figures of joint angles against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from marcha.replay import metrics_joint as mj

T = np.arange(0, 20_000_000_000, 10_000_000)
ANGLE = np.radians(30.0 + 30.0 * np.sin(2 * np.pi * T * 1e-9 / 1.2))


def test_offset_is_bias_and_nothing_else() -> None:
    found = mj.figures(T, ANGLE + np.radians(3.0), T, ANGLE)
    assert found["rmse_deg"] == pytest.approx(3.0)
    assert found["bias_deg"] == pytest.approx(3.0)
    assert found["rmse_unbiased_deg"] == pytest.approx(0.0, abs=1e-9)
    assert found["pearson_r"] == pytest.approx(1.0)
    assert found["rom_error_deg"] == pytest.approx(0.0, abs=1e-9)
    assert found["agreement_low_deg"] == pytest.approx(3.0)
    assert found["cycles"] == 15.0
    assert found["cycle_rmse_deg"] == pytest.approx(3.0)


def test_delay_is_found_at_another_rate() -> None:
    late = np.radians(30.0 + 30.0 * np.sin(2 * np.pi * (T * 1e-9 - 0.034) / 1.2))
    assert mj.figures(T, late, T[::3], ANGLE[::3])["delay_s"] == pytest.approx(0.034, abs=0.001)
    assert np.isnan(mj.delay_s(T, ANGLE, T, 0 * ANGLE))


def test_share_inside_the_stated_95_percent() -> None:
    """Errors drawn with a standard deviation of 1° against 1°, half of it and no statement."""
    noisy = ANGLE + np.radians(np.random.default_rng(0).normal(size=T.size))
    right = mj.figures(T, noisy, T, ANGLE, stated=(T[::2], np.full(T[::2].size, np.radians(1.0))))
    assert right["within95_percent"] == pytest.approx(95.0, abs=1.5)
    assert right["nees"] == pytest.approx(1.0, abs=0.1)
    bold = mj.figures(T, noisy, T, ANGLE, stated=(T, np.full(T.size, np.radians(0.5))))
    assert bold["within95_percent"] == pytest.approx(67.3, abs=4.0)  # erf(0.98 / √2)
    assert bold["nees"] == pytest.approx(4.0, abs=0.4)
    assert "nees" not in mj.figures(T, noisy, T, ANGLE)
    assert mj.consistency(np.ones(3), np.full(3, np.nan)) == {}


def test_range_of_motion_and_limits_of_agreement() -> None:
    assert mj.rom_error_deg(1.1 * ANGLE, ANGLE) == pytest.approx(6.0, abs=0.01)
    low, high = mj.bland_altman_deg(np.array([-1.0, 0.0, 1.0, 2.0]))
    assert (low, high) == pytest.approx((0.5 - 1.96 * np.sqrt(5 / 3), 0.5 + 1.96 * np.sqrt(5 / 3)))


def test_turns_are_no_error_and_gaps_are_not_bridged() -> None:
    assert mj.figures(T, ANGLE + 2 * np.pi, T, ANGLE)["rmse_deg"] == pytest.approx(0.0, abs=1e-9)
    hole = (T > 5e9) & (T < 7e9)
    at, _, _ = mj.matched(T[~hole], ANGLE[~hole], T, ANGLE)
    assert not ((at > 5.01e9) & (at < 6.99e9)).any()
    assert mj.figures(T, np.full(T.size, np.nan), T, ANGLE) == {}


def test_cmc_of_equal_and_of_unrelated_curves() -> None:
    curve = np.sin(np.linspace(0, 2 * np.pi, 101))
    assert mj.cmc(np.stack([curve, curve])) == pytest.approx(1.0)
    assert mj.cmc(np.stack([curve, -curve])) == 0.0
    noisy = curve + 0.1 * np.random.default_rng(0).normal(size=(20, 101))
    assert mj.cmc(noisy) == pytest.approx(np.sqrt(1 - 0.01 / (0.51)), abs=0.003)


def test_cycles_run_from_start_to_start_without_pauses() -> None:
    starts = np.array([0, 1_200_000_000, 2_400_000_000, 9_000_000_000])
    curves = mj.cycles_of(T, ANGLE, starts)
    assert curves.shape == (2, 101)
    np.testing.assert_allclose(
        curves[0], np.radians(30 + 30 * np.sin(np.linspace(0, 2 * np.pi, 101))), atol=1e-3
    )
    found = mj.starts_from_signal(T, ANGLE)
    np.testing.assert_allclose(np.diff(found) * 1e-9, 1.2, atol=0.011)
