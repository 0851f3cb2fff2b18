"""What the engine watches on the channel of a sensor: missing values, repeated and backward times, gaps."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..algorithms.contract import FloatArray, IntArray
from ..recording.errors import Finding, UsageError

JITTER = 1.5
"""Intervals longer than this many sample intervals (and shorter than a gap) are reported as jitter."""


@dataclass(frozen=True)
class GapPolicy:
    """What happens when a regular input of an estimator pauses.

    Attributes
    ----------
    policy : {"bridge", "reset", "stop"}
        ``bridge`` feeds the next sample with its true time difference: the estimator integrates across.
        ``reset`` starts the estimator anew after the gap, in a new segment. ``stop`` ends the run before the
        gap. Every gap is a finding of the run, whatever the policy.
    max_gap_s : float or None
        Longest interval in seconds that is no gap. None: 0.2 s or five sample intervals, whichever is longer.
    """

    policy: Literal["bridge", "reset", "stop"] = "bridge"
    max_gap_s: float | None = None

    def __post_init__(self) -> None:
        if self.policy not in ("bridge", "reset", "stop"):
            raise UsageError(f"gap policy {self.policy!r} is unknown; choose bridge, reset or stop")
        if self.max_gap_s is not None and not self.max_gap_s > 0:
            raise UsageError(f"max_gap_s must be above 0 s, not {self.max_gap_s}")

    def limit_s(self, rate_hz: float) -> float:
        """Return the longest interval that is no gap, in seconds, for a channel of this rate."""
        if self.max_gap_s is not None:
            return self.max_gap_s
        return max(0.2, 5.0 / rate_hz) if rate_hz > 0 else 0.2


Gaps = GapPolicy | Mapping[str, GapPolicy]
"""One policy for all inputs, or one by the name of the input (``""`` for those that are not named)."""


def policy_of(gaps: Gaps, name: str) -> GapPolicy:
    """Return the policy of the input called ``name``."""
    if isinstance(gaps, GapPolicy):
        return gaps
    return gaps.get(name) or gaps.get("") or GapPolicy()


@dataclass
class Tally:
    """How often something happened, when first, and its largest value."""

    count: int = 0
    first_ns: int | None = None
    largest: float = 0.0

    def add(self, times_ns: IntArray, values: FloatArray | None = None) -> None:
        """Count these.

        Shapes: both (n,).
        """
        if not len(times_ns):
            return
        self.count += len(times_ns)
        if self.first_ns is None:
            self.first_ns = int(times_ns[0])
        if values is not None:
            self.largest = max(self.largest, float(values.max()))


@dataclass
class _State:
    """What a guard remembers between two parts."""

    last_ns: int | None = None
    stopped: bool = False
    missing: Tally = field(default_factory=Tally)
    duplicate: Tally = field(default_factory=Tally)
    backwards: Tally = field(default_factory=Tally)
    gaps: Tally = field(default_factory=Tally)
    jitter: Tally = field(default_factory=Tally)
    after_stop: int = 0


class ChannelGuard:
    """Lets through what an estimator may rely on: finite values, ascending times; counts all else.

    Parameters
    ----------
    topic, columns
        The channel and what is read of it.
    gap : GapPolicy
        What happens when it pauses.
    rate_hz : float
        Its rate; 0 where it is not known.
    """

    def __init__(self, topic: str, columns: tuple[str, ...], gap: GapPolicy, rate_hz: float) -> None:
        self.topic = topic
        self.columns = columns
        self.gap = gap
        self.rate_hz = rate_hz
        self.limit_s = gap.limit_s(rate_hz)
        self._state = _State()

    def snapshot(self) -> _State:
        """Return a copy of what the guard remembers."""
        return copy.deepcopy(self._state)

    def restore(self, snapshot: _State) -> None:
        """Go back to ``snapshot``."""
        self._state = copy.deepcopy(snapshot)

    @property
    def stopped(self) -> bool:
        """Whether a gap has ended the run."""
        return self._state.stopped

    @property
    def restarts(self) -> int:
        """Number of restarts so far."""
        return self._state.gaps.count if self.gap.policy == "reset" else 0

    def take(
        self, times: IntArray, finite: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_] | None, FloatArray, tuple[int, ...]]:
        """Return which messages go on (None: all), their time differences in seconds, and where to restart.

        Parameters
        ----------
        times : ndarray of int64, shape (n,)
            Times that the messages speak of.
        finite : ndarray of bool, shape (n,)
            Which have all their values.
        """
        state = self._state
        if state.stopped:
            state.after_stop += len(times)
            return np.zeros(len(times), bool), np.empty(0), ()
        kept, stamped = finite, times
        if not finite.all():
            state.missing.add(times[~finite])
            stamped = times[finite]
        last = state.last_ns if state.last_ns is not None else np.iinfo(np.int64).min
        if stamped.size and (stamped[0] <= last or (stamped[1:] <= stamped[:-1]).any()):
            latest = np.maximum.accumulate(np.concatenate(([last], stamped)))[:-1]
            state.duplicate.add(stamped[stamped == latest])
            state.backwards.add(stamped[stamped < latest])
            later = stamped > latest
            kept = finite.copy()
            kept[np.flatnonzero(finite)[~later]] = False
            stamped = stamped[later]
        if not stamped.size:
            return kept, np.empty(0), ()
        before = stamped[0] if state.last_ns is None else state.last_ns
        dt_s = np.diff(stamped, prepend=before) / 1e9
        gap = dt_s > self.limit_s
        resets: tuple[int, ...] = ()
        if gap.any():
            if self.gap.policy == "stop":
                first = int(np.argmax(gap))
                state.gaps.add(stamped[first : first + 1], dt_s[first : first + 1])
                state.after_stop += len(stamped) - first
                state.stopped = True
                kept = kept.copy()
                kept[np.flatnonzero(kept)[first:]] = False
                stamped, dt_s, gap = stamped[:first], dt_s[:first], gap[:first]
            else:
                state.gaps.add(stamped[gap], dt_s[gap])
                if self.gap.policy == "reset":
                    resets = tuple(np.flatnonzero(gap).tolist())
                    dt_s[gap] = 0.0
        if self.rate_hz > 0:
            uneven = (dt_s > JITTER / self.rate_hz) & ~gap
            state.jitter.add(stamped[uneven], dt_s[uneven])
        if stamped.size:
            state.last_ns = int(stamped[-1])
        return None if kept.all() else kept, dt_s, resets

    def findings(self) -> list[Finding]:
        """Return what was not fed and what was uneven, one line a kind."""
        state = self._state
        findings: list[Finding] = []

        def say(kind: str, tally: Tally, detail: str) -> None:
            if tally.count:
                findings.append(Finding(kind, tally.count, None, f"{self.topic}: {tally.count} {detail}"))

        columns = " ".join(self.columns)
        for kind, tally, rule in (
            ("missing_value", state.missing, f"without a finite value in each of {columns}"),
            ("duplicate_time", state.duplicate, "with the time of the message before"),
            ("backwards_time", state.backwards, "with a time before the message before"),
        ):
            say(kind, tally, f"messages {rule} were not fed, the first at t_ns {tally.first_ns}")
        done = {
            "bridge": "the estimator integrated across",
            "reset": "the estimator started anew after each",
            "stop": f"the run ended before it, {state.after_stop} messages were not fed",
        }[self.gap.policy]
        say(
            "gap",
            state.gaps,
            f"intervals above {self.limit_s:g} s, the longest {state.gaps.largest:.3f} s, the first ends at "
            f"t_ns {state.gaps.first_ns}: {done} (gap policy {self.gap.policy})",
        )
        say(
            "jitter",
            state.jitter,
            f"intervals above {JITTER:g} usual ones ({1e3 / (self.rate_hz or np.inf):.4g} ms), the longest "
            f"{1e3 * state.jitter.largest:.4g} ms: fed with their true time difference",
        )
        return findings
