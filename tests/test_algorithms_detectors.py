"""Streaming detectors equal a plain offline computation over whole arrays, ends included."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.algorithms import make
from marcha.algorithms.foot.detectors import BY_NAME
from marcha.algorithms.foot.detectors.cleaning import CLEANINGS

from .algorithms_support import columns, rows_of, run, simulated

KINDS = ("c1c2c3", "pitch", "shoe", "are", "mv", "mag")
LIMITS = {
    "pitch": {"pitch_dev": 6.0, "pitch_var": 6.0},
    "shoe": {"shoe": 0.3e5},
    "are": {"are": 0.3e5 * np.radians(0.1) ** 2},
    "mv": {"mv": 3.0},
    "mag": {"mag": 3.0},
}
WINDOW = {"c1c2c3": 10, "pitch": 20}
RATE = 100.0


def window(i: int, n: int, length: int, side: str) -> range:
    """Indices of the window around (or behind) sample ``i`` of ``n``, cut off at the ends."""
    before = length // 2 if side == "centred" else length - 1
    return range(max(0, i - before), min(n - 1, i - before + length - 1) + 1)


def total(values: list) -> float:
    """Add from the first to the last, as a loop does (np.sum adds in pairs)."""
    out = np.float64(0.0)
    for value in values:
        out = out + value
    return float(out)


def offline_pitch(rows: np.ndarray, first: int, mean: np.ndarray) -> np.ndarray:
    """Pitch (deg) from the sample that completed the rest on: gravity carried by the rate, pulled at rest."""
    pitch = np.full(len(rows), np.nan)
    g = mean[:3] / np.linalg.norm(mean[:3])
    for i in range(first, len(rows)):
        dt, f, w = rows[i, 0], rows[i, 1:4], rows[i, 4:7]
        half = -0.5 * dt * (w - mean[3:])
        u = np.cross(half, g)
        g = g + 2 / (1 + half @ half) * (u + np.cross(half, u))
        norm = np.linalg.norm(f)
        if 9 < norm < 11 and np.linalg.norm(w) < 0.6:
            g = g + dt / (0.5 + dt) * (f / norm - g)
        g = g / np.linalg.norm(g)
        pitch[i] = np.degrees(np.arctan2(-g[0], np.hypot(g[1], g[2])))
    return pitch


def offline(rows: np.ndarray, kind: str, length: int, side: str, pitch: np.ndarray, ref: float) -> np.ndarray:
    """Statistics of every sample, shape (n, statistics)."""
    n = len(rows)
    f, w = rows[:, 1:4], rows[:, 4:7]
    norm = np.sqrt(f[:, 0] * f[:, 0] + f[:, 1] * f[:, 1] + f[:, 2] * f[:, 2])
    rate = np.sqrt(w[:, 0] * w[:, 0] + w[:, 1] * w[:, 1] + w[:, 2] * w[:, 2])
    out = []
    for i in range(n):
        k = window(i, n, length, side)
        m = len(k)
        if kind in ("c1c2c3", "pitch"):
            x = norm if kind == "c1c2c3" else pitch
            mean = total([x[j] for j in k]) / m
            var = total([(x[j] - mean) * (x[j] - mean) for j in k]) / m
            out.append((norm[i], var, rate[i]) if kind == "c1c2c3" else (abs(pitch[i] - ref), var))
        elif kind == "shoe":
            mean = np.array([total([f[j, a] for j in k]) for a in range(3)])
            mean = mean * (9.81 / np.sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]))
            d = [f[j] - mean for j in k]
            terms = [
                (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) * (1 / 0.01**2)
                + rate[j] * rate[j] * (1 / np.radians(0.1) ** 2)
                for e, j in zip(d, k, strict=True)
            ]
            out.append((total(terms) / m,))
        elif kind == "are":
            out.append((total([rate[j] * rate[j] for j in k]) / m,))
        elif kind == "mv":
            mean = np.array([total([f[j, a] for j in k]) / m for a in range(3)])
            d = [f[j] - mean for j in k]
            out.append((total([e[0] * e[0] + e[1] * e[1] + e[2] * e[2] for e in d]) / m,))
        else:
            out.append((total([(norm[j] - 9.81) * (norm[j] - 9.81) for j in k]) / m,))
    return np.array(out)


def judge(kind: str, stats: np.ndarray) -> np.ndarray:
    if kind == "c1c2c3":
        norm, var, rate = stats.T
        return (norm > 9) & (norm < 11) & (var < 3) & (rate < 0.6)
    with np.errstate(invalid="ignore"):
        return np.logical_and.reduce([stats[:, i] < v for i, v in enumerate(LIMITS[kind].values())])


def runs(flags: np.ndarray) -> list[tuple[int, int, bool]]:
    """Return (first, past the last, value) of every stretch of equal values."""
    edges = [0, *(np.flatnonzero(np.diff(flags)) + 1), len(flags)]
    return [(a, b, bool(flags[a])) for a, b in itertools.pairwise(edges)]


def clean(raw: np.ndarray, cleaning: str, length: int, side: str) -> np.ndarray:
    n = len(raw)
    if cleaning == "median":
        shares = [np.mean([raw[j] for j in window(i, n, length, side)]) for i in range(n)]
        return np.array(shares) > 0.5
    out = raw.copy()
    if cleaning == "fill-burst":
        for a, b, value in runs(raw):
            if not value and a > 0 and b < n and b - a < length:
                out[a:b] = True
        for a, b, value in runs(out.copy()):
            if value and b - a < length:
                out[a:b] = False
    return out


def noisy_rows(n: int, seed: int) -> np.ndarray:
    """Rest for 40 samples, then bursts of motion of random lengths: many short gaps and short stances."""
    rng = np.random.default_rng(seed)
    moving = np.repeat(rng.random(n) < 0.5, rng.integers(1, 25, n))[:n]
    moving[:40] = False
    acc = np.array([1.0, 0.5, 9.7]) + rng.normal(0, 0.02, (n, 3)) + moving[:, None] * rng.normal(0, 3, (n, 3))
    gyr = rng.normal(0, 0.01, (n, 3)) + moving[:, None] * rng.normal(0, 1, (n, 3))
    return rows_of(np.arange(n) / RATE, acc, gyr)


@pytest.mark.parametrize("side", ["centred", "trailing"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("source", ["walk", "noise"])
def test_statistics_equal_the_offline_ones(kind: str, side: str, source: str) -> None:
    rows = simulated(rest_s=0.8)[0][:500] if source == "walk" else noisy_rows(400, 3)
    result, estimator = run("foot.naive", rows, detector=kind, window_side=side, init_s=0.3, rate_hz=RATE)
    first = int(np.flatnonzero(np.isfinite(result["pose.pos_x"]))[0])
    mean = rows[: first + 1, 1:7].mean(axis=0)
    pitch = offline_pitch(rows, first, mean)
    ref = np.degrees(np.arctan2(-mean[0], np.hypot(mean[1], mean[2])))
    wanted = offline(rows, kind, WINDOW.get(kind, 5), side, pitch, ref)
    got = columns(result, "detector")
    assert got.shape[1] == len(BY_NAME[kind].statistics)
    if kind == "pitch":  # carried by sines of the mechanization: same to rounding
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9, equal_nan=True)
    else:
        np.testing.assert_array_equal(got, wanted)
    assert estimator.latency > 0 or side == "trailing"


@pytest.mark.parametrize("cleaning", CLEANINGS)
@pytest.mark.parametrize("side", ["centred", "trailing"])
@pytest.mark.parametrize("kind", KINDS)
def test_decisions_equal_the_offline_ones(kind: str, side: str, cleaning: str) -> None:
    for rows in (noisy_rows(700, 5), simulated(rest_s=0.8)[0][:700]):
        result, _ = run("foot.naive", rows, detector=kind, window_side=side, cleaning=cleaning, init_s=0.3)
        raw = judge(kind, columns(result, "detector"))
        np.testing.assert_array_equal(result["stance.still"], clean(raw, cleaning, 10, side))
        assert 0 < raw.mean() < 1


@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 120),
    length=st.integers(1, 17),
    cleaning=st.sampled_from(CLEANINGS),
    side=st.sampled_from(["centred", "trailing"]),
)
def test_cleaning_equals_the_offline_one_for_any_length(
    seed: int, n: int, length: int, cleaning: str, side: str
) -> None:
    rows = noisy_rows(n + 40, seed)[40:]
    result, estimator = run(
        "foot.naive",
        rows,
        detector="are",
        window_s=0.01,
        cleaning=cleaning,
        cleaning_s=length / RATE,
        window_side=side,
    )
    raw = judge("are", columns(result, "detector"))
    np.testing.assert_array_equal(result["stance.still"], clean(raw, cleaning, length, side))
    assert (
        estimator.latency
        == {
            "none": 0,
            "median": (length - 1 - length // 2) if side == "centred" else 0,
            "fill-burst": 2 * (length - 1),
        }[cleaning]
    )


@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0, 397.0])
def test_windows_last_as_long_at_any_rate(rate: float) -> None:
    estimator = make("foot.9iez", preset="published", rate_hz=rate)
    window_s, cleaning_s = round(0.1 * rate), round(0.1 * rate)
    after = window_s - 1 - window_s // 2 + cleaning_s - 1 - cleaning_s // 2
    assert estimator.latency == after


def test_a_trailing_detector_without_cleaning_has_no_latency() -> None:
    assert make("foot.9iez", detector="c1c2c3", window_side="trailing", cleaning="none").latency == 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("preset", [None, "tuned"])
def test_a_simulated_walk_is_cut_into_its_steps(kind: str, preset: str | None) -> None:
    rows, walk = simulated(strike_mm=0.3)
    name = {"shoe": "shoe-tuned", "are": "are-tuned", "mv": "mv-tuned", "mag": "mag-tuned"}.get(kind)
    if preset and not name:
        pytest.skip("the source's thresholds need no tuned set")
    params = {"preset": name} if preset else {"detector": kind}
    if kind in ("mv", "mag") and not preset:
        pytest.skip("the source's threshold (3 m²/s⁴) is too loose for this device: see docs/estimators.md")
    result, _ = run("foot.9iez", rows, **params)
    steps = np.isfinite(result["step.index"]).sum()
    assert abs(steps - walk.steps.height) <= 1
    agreement = (result["stance.still"] == walk.still)[200:].mean()
    assert agreement > 0.85, agreement
