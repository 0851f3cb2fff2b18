"""Statistics of a study: outliers, normality, pairwise comparison of means, and families of tests.

Everything here takes plain arrays. Where there are too few samples nothing is computed and ``note`` says why.

References
----------
Welch, B. L. (1947), Biometrika 34, 28-35. Hedges, L. V. (1981), J. Educational Statistics 6, 107-128 (g and
its exact correction). Holm, S. (1979), Scand. J. Statistics 6, 65-70. Brunner, E. and Munzel, U. (2000),
Biometrical Journal 42, 17-25. Steiger, J. H. and Fouladi, R. T. (1997) (interval of an effect size by the
noncentral t).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

NAN = math.nan


class GroupSummary(msgspec.Struct, frozen=True):
    """Summary of one group's values.

    Attributes
    ----------
    n : int
        Values that count: finite ones without outliers.
    outliers, missing : int
        Values left out by the sigma rule; values that were not finite.
    mean, sd, median, minimum, maximum : float
        Of the values that count; sd with n − 1. NaN where undefined.
    shapiro_w, shapiro_p : float
        Shapiro-Wilk statistic and p value; NaN where not computed.
    note : str
        Why something was not computed.
    """

    n: int
    outliers: int
    missing: int
    mean: float
    sd: float
    median: float
    minimum: float
    maximum: float
    shapiro_w: float
    shapiro_p: float
    note: str = ""


class GroupComparison(msgspec.Struct, frozen=True):
    """Two groups compared.

    Attributes
    ----------
    n_a, n_b : int
        Sizes.
    difference, difference_low, difference_high : float
        Mean of a minus mean of b with Welch's interval.
    welch_t, welch_df, welch_p : float
        Welch's t test, two-sided.
    hedges_g, hedges_low, hedges_high : float
        Effect size (pooled standard deviation, exact small-sample correction) with its interval from the
        noncentral t distribution, which assumes equal variances.
    rank_p : float
        Two-sided p value of the non-parametric twin.
    welch_p_holm, rank_p_holm : float
        The p values corrected by Holm within their family; NaN until :func:`corrected`.
    note : str
        Why something was not computed.
    """

    n_a: int
    n_b: int
    difference: float = NAN
    difference_low: float = NAN
    difference_high: float = NAN
    welch_t: float = NAN
    welch_df: float = NAN
    welch_p: float = NAN
    hedges_g: float = NAN
    hedges_low: float = NAN
    hedges_high: float = NAN
    rank_p: float = NAN
    welch_p_holm: float = NAN
    rank_p_holm: float = NAN
    note: str = ""


def outlier_mask(values: ArrayLike, sigma: float) -> NDArray[np.bool_]:
    """Tell which values lie more than ``sigma`` standard deviations (n − 1) from the mean, in one pass.

    Values that are not finite are neither counted nor flagged. ``sigma`` 0 flags nothing. Among n values none
    can lie farther than (n − 1)/√n standard deviations from the mean, so three sigma never strikes below 11
    values.
    """
    x = np.asarray(values, float)
    good = np.isfinite(x)
    flagged = np.zeros(x.shape, bool)
    if sigma > 0 and good.sum() > 1:
        mean, sd = x[good].mean(), x[good].std(ddof=1)
        flagged[good] = np.abs(x[good] - mean) > sigma * sd
    return flagged


def kept(values: ArrayLike, sigma: float) -> NDArray[np.float64]:
    """Return the finite values without outliers."""
    x = np.asarray(values, float)
    return x[np.isfinite(x) & ~outlier_mask(x, sigma)]


def summarize(values: ArrayLike, *, sigma: float = 3.0, min_samples: int = 3) -> GroupSummary:
    """Summarize one group: outliers by the sigma rule, moments, Shapiro-Wilk."""
    from scipy import stats

    x = np.asarray(values, float)
    missing = int((~np.isfinite(x)).sum())
    outliers = int(outlier_mask(x, sigma).sum())
    x = kept(x, sigma)
    n = len(x)
    w = p = NAN
    note = ""
    if n < max(3, min_samples):
        note = f"normality not tested: {n} values, {max(3, min_samples)} needed"
    elif np.ptp(x) <= 1e-12 * np.abs(x).max():
        note = "normality not tested: all values are equal"
    else:
        w, p = (float(v) for v in stats.shapiro(x))
        if n > 5000:
            note = "Shapiro-Wilk is not accurate above 5000 values"
    empty = n == 0
    return GroupSummary(
        n=n,
        outliers=outliers,
        missing=missing,
        mean=NAN if empty else float(x.mean()),
        sd=float(x.std(ddof=1)) if n > 1 else NAN,
        median=NAN if empty else float(np.median(x)),
        minimum=NAN if empty else float(x.min()),
        maximum=NAN if empty else float(x.max()),
        shapiro_w=w,
        shapiro_p=p,
        note=note,
    )


def hedges_g(a: ArrayLike, b: ArrayLike, confidence: float = 0.95) -> tuple[float, float, float]:
    """Return Hedges' g of two samples and its interval.

    g = J (mean(a) − mean(b)) / s_pooled with J = Γ(m/2) / (√(m/2) Γ((m − 1)/2)), m = n_a + n_b − 2. The
    interval are the noncentralities of the t distribution under which the observed t lies at either tail
    (equal variances assumed).
    """
    from scipy import special

    x, y = np.asarray(a, float), np.asarray(b, float)
    n, k = len(x), len(y)
    m = n + k - 2
    pooled = math.sqrt(((n - 1) * x.var(ddof=1) + (k - 1) * y.var(ddof=1)) / m)
    j = math.exp(special.gammaln(m / 2) - special.gammaln((m - 1) / 2)) / math.sqrt(m / 2)
    root = math.sqrt(1 / n + 1 / k)
    d = (x.mean() - y.mean()) / pooled
    t = d / root

    tail = (1 - confidence) / 2
    low, high = (float(special.nctdtrinc(m, q, t)) for q in (1 - tail, tail))
    return j * d, j * root * low, j * root * high


def compare(
    a: ArrayLike,
    b: ArrayLike,
    *,
    confidence: float = 0.95,
    min_samples: int = 3,
    nonparametric: Literal["mann-whitney", "brunner-munzel"] = "mann-whitney",
) -> GroupComparison:
    """Compare two independent samples (finite values, outliers left out by the caller)."""
    from scipy import stats

    x, y = np.asarray(a, float), np.asarray(b, float)
    n, k = len(x), len(y)
    if min(n, k) < min_samples:
        return GroupComparison(n, k, note=f"not tested: {n} and {k} values, {min_samples} each needed")
    scale = max(np.abs(x).max(), np.abs(y).max())
    if x.std(ddof=1) + y.std(ddof=1) <= 1e-12 * scale:
        difference = float(x.mean() - y.mean())
        return GroupComparison(n, k, difference=difference, note="not tested: no spread in either group")
    welch: Any = stats.ttest_ind(x, y, equal_var=False)
    low, high = welch.confidence_interval(confidence)
    g, g_low, g_high = hedges_g(x, y, confidence)
    if nonparametric == "mann-whitney":
        rank_p = float(stats.mannwhitneyu(x, y).pvalue)
    else:
        with np.errstate(all="ignore"):
            rank_p = float(stats.brunnermunzel(x, y).pvalue)
    return GroupComparison(
        n_a=n,
        n_b=k,
        difference=float(x.mean() - y.mean()),
        difference_low=float(low),
        difference_high=float(high),
        welch_t=float(welch.statistic),
        welch_df=float(welch.df),
        welch_p=float(welch.pvalue),
        hedges_g=g,
        hedges_low=g_low,
        hedges_high=g_high,
        rank_p=rank_p,
    )


class PairedComparison(msgspec.Struct, frozen=True):
    """Two values of each walk compared.

    Attributes
    ----------
    n : int
        Pairs.
    difference, difference_low, difference_high : float
        Mean of a − b with its interval by Student's t.
    t, t_p : float
        Paired t test, two-sided, with n − 1 degrees of freedom.
    effect, effect_low, effect_high : float
        Mean difference over its standard deviation (Cohen's d for paired values), with its interval from the
        noncentral t distribution.
    rank_effect : float
        Matched-pairs rank-biserial correlation (Kerby 2014): share of the ranks in favour of a > b less the rest.
    rank_p : float
        Wilcoxon's signed-rank test, two-sided.
    t_p_holm, rank_p_holm : float
        Corrected by Holm within their family; NaN until then.
    note : str
        Why something was not computed.
    """

    n: int
    difference: float = NAN
    difference_low: float = NAN
    difference_high: float = NAN
    t: float = NAN
    t_p: float = NAN
    effect: float = NAN
    effect_low: float = NAN
    effect_high: float = NAN
    rank_effect: float = NAN
    rank_p: float = NAN
    t_p_holm: float = NAN
    rank_p_holm: float = NAN
    note: str = ""


def paired(a: ArrayLike, b: ArrayLike, *, confidence: float = 0.95, min_samples: int = 3) -> PairedComparison:
    """Compare two values of the same walks (finite, in the same order)."""
    from scipy import special, stats

    x, y = np.asarray(a, float), np.asarray(b, float)
    difference = x - y
    n = len(difference)
    if n < min_samples:
        return PairedComparison(n, note=f"not tested: {n} pairs, {min_samples} needed")
    mean, sd = float(difference.mean()), float(difference.std(ddof=1))
    if sd <= 1e-12 * max(np.abs(x).max(), np.abs(y).max()):
        return PairedComparison(n, difference=mean, note="not tested: no spread of the differences")
    test: Any = stats.ttest_rel(x, y)
    rank: Any = stats.wilcoxon(x, y)
    low, high = test.confidence_interval(confidence)
    tail = (1 - confidence) / 2
    root = math.sqrt(n)
    d_low, d_high = (float(special.nctdtrinc(n - 1, q, test.statistic)) / root for q in (1 - tail, tail))
    moved = difference[difference != 0]
    ranks = stats.rankdata(np.abs(moved))
    return PairedComparison(
        n=n,
        difference=mean,
        difference_low=float(low),
        difference_high=float(high),
        t=float(test.statistic),
        t_p=float(test.pvalue),
        effect=mean / sd,
        effect_low=d_low,
        effect_high=d_high,
        rank_effect=float((ranks * np.sign(moved)).sum() / ranks.sum()),
        rank_p=float(rank.pvalue),
    )


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Return p values corrected by Holm's step-down rule; NaN entries are no members of the family."""
    p = np.asarray(p_values, float)
    adjusted = np.full(p.shape, NAN)
    (members,) = np.nonzero(np.isfinite(p))
    order = members[np.argsort(p[members], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * factors), 1.0)
    return adjusted


def corrected(family: Sequence[GroupComparison]) -> list[GroupComparison]:
    """Return the comparisons of one family with their p values corrected by Holm, both tests apart."""
    welch = holm([c.welch_p for c in family])
    rank = holm([c.rank_p for c in family])
    return [
        msgspec.structs.replace(c, welch_p_holm=float(w), rank_p_holm=float(r))
        for c, w, r in zip(family, welch, rank, strict=True)
    ]


def normal_quantiles(count: int) -> NDArray[np.float64]:
    """Return the quantiles of ``count`` ordered normal values (Filliben 1975), the axis of a Q-Q plot."""
    from scipy.special import ndtri

    share = (np.arange(1, count + 1) - 0.3175) / (count + 0.365)
    share[-1] = 0.5 ** (1 / count)
    share[0] = 1 - share[-1]
    return ndtri(share)
