"""The worked figures of the source, to the digits that it prints or that its equations give."""

from __future__ import annotations

import numpy as np
import pytest
from marcha.algorithms import AlgorithmError
from marcha.algorithms.indoor import lateration as lat
from marcha.algorithms.indoor import pathloss as pl

METRES = np.arange(1.0, 11.0)
POWERS = np.array([-57.55, -67.45, -66.88, -68.23, -68.77, -68.37, -68.35, -68.85, -72.07, -70.44])
ETAS = (3.289, 1.956, 1.774, 1.605, 1.391, 1.278, 1.251, 1.522, 1.289)
FLOOR = np.array([[23.1, 1.5], [1.5, 6.9], [3.9, 1.5], [8.1, 5.7], [18.3, 6.3], [17.7, 0.9]])


def test_the_worked_calibration_gives_its_nine_exponents():
    found = pl.calibrate_by_distances(METRES, POWERS)
    assert found.p_d0_dbm == -57.55
    assert found.eta_by_distance == pytest.approx(ETAS, abs=1e-3)
    assert found.eta == pytest.approx(1.706, abs=1e-3)
    rounded = POWERS - pl.power_dbm(METRES, -57.55, 1.71)  # the exponent as the source uses it
    assert np.sqrt(np.mean(rounded**2)) == pytest.approx(2.87, abs=5e-3)
    assert found.residual_db == pytest.approx(2.85, abs=5e-3)
    ranges = pl.distance_m(POWERS, -57.55, 1.71)
    assert ranges == pytest.approx([1.00, 3.79, 3.51, 4.21, 4.53, 4.29, 4.28, 4.58, 7.07, 5.67], abs=0.01)


def test_the_regression_on_the_same_powers():
    found = pl.regress(METRES, POWERS)
    assert found.p_d0_dbm == pytest.approx(-60.76, abs=5e-3)
    assert found.eta == pytest.approx(1.058, abs=5e-4)
    assert found.residual_db == pytest.approx(1.79, abs=5e-3)


def test_the_trimmed_mean_drops_five_at_each_end():
    samples = np.r_[np.full(40, -60.0), np.full(5, -90.0), np.full(5, -30.0)]
    assert pl.trimmed_mean(samples) == -60.0
    assert pl.trimmed_mean([-60.0, -70.0]) == -65.0  # too few to drop any
    with pytest.raises(AlgorithmError):
        pl.trimmed_mean([])


def test_free_space_is_the_model_with_exponent_two():
    loss = pl.free_space_loss_db([1.0, 10.0, 100.0], 2.44e9)
    assert np.diff(loss) == pytest.approx([20.0, 20.0])
    assert loss[0] == pytest.approx(40.2, abs=0.05)
    assert pl.power_dbm([1, 10, 100], -loss[0], 2.0) == pytest.approx(-loss)


def test_distance_undoes_power():
    d = np.geomspace(0.1, 80, 20)
    assert pl.distance_m(pl.power_dbm(d, -57.55, 1.71), -57.55, 1.71) == pytest.approx(d)


def test_ranges_in_the_plane():
    assert pl.plane_range_m([5.0, 1.0], [3.0, 3.0]).tolist() == [4.0, 0.0]


def test_calibration_refuses_what_cannot_tell():
    with pytest.raises(AlgorithmError, match="1 m"):
        pl.calibrate_by_distances([2.0, 3.0], [-60.0, -65.0])
    with pytest.raises(AlgorithmError, match="one distance"):
        pl.regress([2.0, 2.0, 2.0], [-60.0, -65.0, -62.0])
    with pytest.raises(AlgorithmError, match="positive"):
        pl.regress([0.0, 2.0], [-60.0, -65.0])


def test_an_exponent_out_of_the_ordinary_is_doubted():
    assert "0.40" in pl.PathLoss(-60, 0.4, 1.0).doubt
    assert pl.PathLoss(-60, 1.7, 1.0).doubt == ""


def test_exact_ranges_give_the_position_and_the_printed_sign_would_not():
    three, truth = FLOOR[2:5], np.array([10.0, 4.0])
    ranges = np.linalg.norm(three - truth, axis=1)
    assert np.abs(lat.solve_triple(three, ranges) - truth).max() < 1e-9
    printed = 2 * (three[:2] - three[2])
    right = (three[:2] ** 2 - three[2] ** 2).sum(axis=1) + ranges[:2] ** 2 - ranges[2] ** 2
    assert np.linalg.solve(printed, right) == pytest.approx([17.6, -12.4], abs=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_every_method_is_exact_on_exact_ranges(seed):
    rng = np.random.default_rng(seed)
    truth = rng.uniform([2, 1], [22, 6])
    ranges = np.linalg.norm(FLOOR - truth, axis=1)
    assert lat.mean_of_triples(FLOOR, ranges) == pytest.approx(truth, abs=1e-8)
    fix = lat.least_squares(FLOOR, ranges, 0.3)
    assert fix is not None
    assert fix.position == pytest.approx(truth, abs=1e-6)
    assert fix.chi2 == pytest.approx(0, abs=1e-9)


def test_least_squares_knows_heights():
    truth, up = np.array([10.0, 4.0]), np.array([1.6, 1.6, -0.2, -0.2, -0.2, -0.2])
    ranges = np.sqrt(((FLOOR - truth) ** 2).sum(axis=1) + up**2)
    fix = lat.least_squares(FLOOR, ranges, 0.3, heights=up)
    assert fix is not None
    assert fix.position == pytest.approx(truth, abs=1e-6)


def test_the_covariance_is_that_of_the_errors():
    """Monte Carlo: squared errors weighted by the stated covariance are chi-square with two degrees."""
    rng = np.random.default_rng(2)
    truth, sigma = np.array([12.0, 4.0]), 0.1
    exact = np.linalg.norm(FLOOR - truth, axis=1)
    squared = []
    for _ in range(300):
        fix = lat.least_squares(FLOOR, exact * np.exp(sigma * rng.standard_normal(6)), sigma)
        assert fix is not None
        error = fix.position - truth
        squared.append(error @ np.linalg.solve(fix.covariance, error))
    assert 1.6 < np.mean(squared) < 2.6
    assert np.mean(np.array(squared) < 5.991) > 0.9


def test_the_covariance_is_the_bound():
    truth = np.array([12.0, 4.0])
    fix = lat.least_squares(FLOOR, np.linalg.norm(FLOOR - truth, axis=1), 0.2)
    assert fix is not None
    assert np.sqrt(np.trace(fix.covariance)) == pytest.approx(
        lat.cramer_rao_m(truth, FLOOR, 0.2)[0], rel=1e-6
    )


def test_dilution_of_known_geometry():
    square = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    assert lat.dilution([0.0, 0.0], square)[0] == pytest.approx(1.0)  # two ranges an axis: √(1/2 + 1/2)
    assert np.isinf(lat.dilution([5.0, 0.0], square[:2])[0])


def test_the_map_shows_where_an_anchor_is_missing():
    now = lat.geometry_map(FLOOR[:4], 0.3, low=(0, 0), high=(24, 8))
    more = lat.geometry_map(FLOOR[:5], 0.3, low=(0, 0), high=(24, 8))
    assert now["bound_m"].shape == (48, 16)
    assert (more["bound_m"] <= now["bound_m"] + 1e-9).all()
    gain = now["bound_m"] - more["bound_m"]
    at = np.unravel_index(np.argmax(np.where(np.isfinite(gain), gain, 0)), gain.shape)
    assert np.hypot(now["x"][at[0]] - 18.3, now["y"][at[1]] - 6.3) < 8
    assert lat.geometry_map(FLOOR, 0.3, low=(0, 0), high=(24, 8), reach_m=3.0)["heard"].min() == 0


def test_anchors_on_a_line_give_no_position():
    line = np.array([[0.0, 0.0], [5.0, 0.0], [10.0, 0.0]])
    assert lat.flatness(line) == 0
    assert np.isnan(lat.mean_of_triples(line, [3.0, 4.0, 8.0])).all()
    assert np.isnan(lat.solve_triple(line, [3.0, 4.0, 8.0])).all()
    assert np.isinf(lat.cramer_rao_m([3.0, 0.0], line, 0.3)[0])
    triangle = [[0, 0], [1, 0], [0.5, np.sqrt(3) / 2]]
    assert lat.flatness(triangle) == pytest.approx(1.0)


class TestVotes:
    """Anchors on a line of 10 m steps, so that the sums can be done in the head."""

    anchors = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])

    def test_nothing_to_correct(self):
        assert lat.votes(self.anchors, [6, 5, 15]).tolist() == [0, 0, 0]
        assert lat.corrected(self.anchors, [6, 5, 15]).tolist() == [6, 5, 15]

    def test_a_short_range_is_outvoted(self):
        # from 0: 10 − 1 > 1.25·5 (vote), 20 − 1 > 1.25·15 (vote); from 1: 10 − 5 > 1.25·1 (vote), not of 2
        assert lat.votes(self.anchors, [1, 5, 15]).tolist() == [2, 1, 1]
        # anchors 1 and 2 tie with one vote: the shorter range, 5 of anchor 1, is the reference; half of two
        # possible votes is one, so 2 is corrected too: 10 − 5 both
        assert lat.corrected(self.anchors, [1, 5, 15]).tolist() == [5, 5, 5]

    def test_never_negative(self):
        anchors = np.array([[0.0, 0.0], [3.0, 0.0], [30.0, 0.0], [0.0, 30.0]])
        # nobody contradicts 29 m of the first, so it is the reference; each other one has two of three votes
        ranges = [29.0, 1.0, 2.0, 2.0]
        assert lat.votes(anchors, ranges).tolist() == [0, 2, 2, 2]
        assert lat.corrected(anchors, ranges).tolist() == [29.0, 0.0, 1.0, 1.0]  # 3 − 29 is not a range

    def test_ties_take_the_shortest_range(self):
        two = self.anchors[:2]
        # each has the other's vote; the shorter is the reference
        assert lat.corrected(two, [3.0, 2.0]).tolist() == [8.0, 2.0]
        assert lat.corrected(two, [2.0, 3.0]).tolist() == [2.0, 8.0]

    def test_too_long_ranges_are_seen_by_both_only(self):
        anchors = np.array([[0.0, 0.0], [4.0, 0.0], [2.0, 3.0]])
        ranges = [1.0, 20.0, 3.0]
        assert lat.corrected(anchors, ranges, "votes").tolist() == ranges
        assert lat.corrected(anchors, ranges, "both").tolist() == [1.0, 5.0, 3.0]
        assert lat.corrected(anchors, ranges, "none").tolist() == ranges
