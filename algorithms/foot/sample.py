"""One sample on its way through a foot estimator, and the ring that holds the newest ones."""

from __future__ import annotations

from ..numerics.records import record_type

SAMPLE = record_type(
    ("dt", "f8"),  # s since the previous sample
    ("acc", "f8", (3,)),  # specific force, m/s², b
    ("gyr", "f8", (3,)),  # angular rate, rad/s, b
    ("extra", "f8", (4,)),  # columns of the further inputs, NaN where none arrived
    ("acc_norm", "f8"),
    ("gyr_norm", "f8"),
    ("doubt", "f8", (3,)),  # rad²/s a second, variance of a rate that was put back beyond a ceiling
    ("pitch", "f8"),  # deg, where the detector follows it
    ("statistic", "f8", (3,)),  # of the detector, as many as it has
    ("queue", "i8"),  # place in the queue of an adaptive detector
    ("raw", "?"),  # the detector's decision about this sample alone
    ("filled", "?"),  # after short gaps were closed
    ("still", "?"),  # the decision
)
"""Sample k lies at ``ring[k & (len(ring) − 1)]``: the ring's length is a power of two."""
