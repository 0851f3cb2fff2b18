"""Repair of a device's time column, block by block, every repair named."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

from ..recording import MarchaError
from .contract import ReportBuilder

Int64Array = NDArray[np.int64]

#: Times beyond this (ns) would not fit 64 bits where a clock is moved: what reads them leaves their rows out.
MOST_NS = 4 * 10**18
#: What stands for such a time (ns), so that it is not taken for another.
FAR_NS = 2 * MOST_NS
#: Rates that a file or a user may state (Hz): with others, times of rows overflow or are all the same.
RATES_HZ = (1e-3, 1e7)
Rate = Annotated[float, msgspec.Meta(ge=RATES_HZ[0], le=RATES_HZ[1])]
#: A run of fewer rows whose time stands back is a slip of those rows; a longer one is a clock set anew.
SLIP_ROWS = 20
#: Intervals longer than this many nominal ones miss a row; longer than LONG_GAP ones, the source lost data.
GAP, LONG_GAP = 1.8, 10.0
#: Intervals off the nominal one by more than this share (and more than one tick) are jitter.
JITTER = 0.1
#: Stamps are bursty where the mean interval is less than this share of the median.
BURSTY = 0.92
#: A counter that wraps goes on within this time of its last value; anything else is a step back.
ROLLOVER_S = 3600.0


def nanoseconds(
    values: ArrayLike, factor: float, origin: int | Int64Array = 0, tick_ns: int = 1
) -> Int64Array:
    """Return whole nanoseconds; :data:`FAR_NS` where no clock can say the time, or where there is none.

    Parameters
    ----------
    values : array_like of float, (n,)
        Times in any unit.
    factor : float
        Ticks in that unit, to which times are rounded.
    origin : int or array of int, (n,)
        Time (ns) at zero.
    tick_ns : int
        Nanoseconds of a tick.
    """
    ticks = np.rint(np.asarray(values, np.float64) * factor)
    possible = np.abs(ticks) <= MOST_NS // tick_ns
    return np.where(possible, origin + np.where(possible, ticks, 0.0).astype(np.int64) * tick_ns, FAR_NS)


def possible_rate(rate_hz: float, path: Path, remedy: str) -> float:
    """Return a rate that a file states, or refuse it.

    Raises
    ------
    MarchaError
        It is not within :data:`RATES_HZ`.
    """
    low, high = RATES_HZ
    if not low <= rate_hz <= high:
        raise MarchaError(
            f"{path}: {rate_hz:g} Hz is the rate of no sensor ({low:g} to {high:g} Hz); {remedy}"
        )
    return rate_hz


class TimestampRepair:
    """Turns a column of device ticks into time stamps that never decrease.

    What it does, and under which name it reports:

    ``counter_rollover``
        the counter wrapped: the rows that follow are moved by its period (repair).
    ``duplicate_row``
        a row equal to the one before in every column: dropped.
    ``duplicate_time``
        equal time, other values: kept as it is.
    ``backwards_time``
        fewer than 20 rows stand before their predecessor: dropped; a short run that jumps ahead and comes
        back is dropped likewise; a longer run is a clock that started again: it and all that follows is moved
        to one nominal interval behind the last row (repair).
    ``gap``, ``jitter``
        intervals above 1.8 nominal ones, and intervals off by more than 10 %: reported, nothing is filled in.

    ``bursty_stamps``
        the mean interval is more than 8 % below the median: the mean is the nominal one.

    Parameters
    ----------
    report : ReportBuilder
        Where findings go; rows that :meth:`feed` returns are counted as kept.
    tick_ns : int
        Nanoseconds of one tick.
    period : int, optional
        Number of ticks after which the counter wraps (2**32 for ``millis()``).
    subject : str
        Which clock, where a source has several: it stands before each detail.
    even : bool
        Whether the device samples at a fixed rate, so that gaps and jitter mean something.

    Notes
    -----
    A frame that is fed has ``t`` (Int64, ticks), ``line`` (Int64) and any other columns; what returns has
    ``t_ns`` in the place of ``t``. Rows that cannot be judged before the next block are held back: call with
    ``final=True`` at the end.
    """

    def __init__(
        self,
        report: ReportBuilder,
        *,
        tick_ns: int,
        period: int | None = None,
        subject: str = "",
        even: bool = True,
    ) -> None:
        self._report = report
        self._tick_ns = tick_ns
        self._period = period
        self._subject = subject
        self._even = even
        self._raw: int | None = None  # last raw tick
        self._raw_step = 0  # and the step to it
        self._turns = 0  # ticks added by roll-overs
        self._shift = 0  # ticks added by restarts
        self._last: int | None = None  # last tick handed out, after both
        self._last_row: tuple[object, ...] | None = None
        self._held: pl.DataFrame | None = None
        self._nominal: int | None = None
        self._longest = [0, 0]  # of gap and jitter intervals, ticks
        self._where: list[int | None] = [None, None]
        self._counts = [0, 0]

    def stream(self, frames: Iterable[pl.DataFrame]) -> Iterator[pl.DataFrame]:
        """Feed all of ``frames`` and yield what is settled, to the end; empty frames are left out."""
        empty: pl.DataFrame | None = None
        for frame in frames:
            empty = frame.clear()
            if (settled := self.feed(frame)).height:
                yield settled
        if empty is not None and (settled := self.feed(empty, final=True)).height:
            yield settled

    def feed(self, frame: pl.DataFrame, *, final: bool = False) -> pl.DataFrame:
        """Return the rows that are settled, with ``t_ns`` (Int64, never decreasing) in the place of ``t``."""
        if frame.height:
            frame = self._possible(frame)
        if frame.height and self._period is not None:
            frame = frame.with_columns(t=pl.Series(self._unwrap(frame, self._period)))
        if self._held is not None:
            frame, self._held = pl.concat([self._held, frame], rechunk=True), None
        ticks = frame["t"].to_numpy() + self._shift
        if self._nominal is None and ticks.size > 1:
            steps = np.diff(ticks)
            self._nominal = self._interval(steps[steps > 0], int(frame["line"][0]))
        steps = np.diff(ticks, prepend=ticks[:1] if self._last is None else self._last)
        if steps.size and (steps[1:].min(initial=1) <= 0 or steps[0] < 0 or steps.max() > self._jump):
            frame, ticks = self._settle(frame, ticks, steps, final)
        elif self._last is not None and steps.size and steps[0] == 0:
            frame, ticks = self._drop_repeats(frame, ticks)
        if frame.height:
            self._measure(frame, ticks)
            if self._shift:
                self._report.repaired += int(np.count_nonzero(frame["t"].to_numpy() != ticks))
            self._last = int(ticks[-1])
            self._last_row = _readings(frame[-1:]).row(0)
        if final:
            self._summary()
        self._report.keep(frame.height)
        stamp = pl.Series("t_ns", ticks * self._tick_ns, dtype=pl.Int64)
        return pl.DataFrame([stamp, *(s for s in frame.get_columns() if s.name != "t")])

    def _possible(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return the rows whose time a clock can say: arithmetic on others would wrap."""
        most = MOST_NS // self._tick_ns
        t = frame["t"]
        if not t.null_count() and -most <= int(t.to_numpy().min()) and int(t.to_numpy().max()) <= most:
            return frame
        good = t.is_between(-most, most).fill_null(False)
        first = int((~good).arg_true()[0])
        self._report.drop(
            "bad_row",
            f"{self._subject}time {frame['t'][first]} is beyond any clock; row dropped",
            count=int((~good).sum()),
            line=frame["line"][first],
            subject=f"{self._subject}beyond",
        )
        return frame.filter(good)

    def _interval(self, steps: Int64Array, line: int) -> int | None:
        """Return the sensor's interval: the median, or the mean where stamps come in bursts.

        Readings that are stamped as they arrive, several at once, have many short intervals and some long ones:
        their mean is the sensor's, their median is not. Lost rows make the mean longer, never shorter.
        """
        if not steps.size:
            return None
        median = float(np.median(steps))
        mean = float(steps[steps <= LONG_GAP * median].mean())
        if steps.size < 20 or mean > BURSTY * median:
            return int(median)
        self._report.note(
            "bursty_stamps",
            f"{self._subject}time stamps come in bursts: half of the intervals are longer than "
            f"{self._text(int(median))}, their mean is {self._text(int(mean))}; the mean is taken for the sensor's",
            line=line,
            subject=self._subject,
        )
        return max(1, int(mean))

    @property
    def _jump(self) -> int:
        """Ticks above which an interval may be a damaged number instead of a gap."""
        second = 1_000_000_000 // self._tick_ns
        return max(second, 100 * (self._nominal or 0))

    def _unwrap(self, frame: pl.DataFrame, period: int) -> Int64Array:
        raw = frame["t"].to_numpy()
        steps = np.diff(raw, prepend=raw[0] if self._raw is None else self._raw)
        window = ROLLOVER_S * 1e9 / self._tick_ns
        into = np.concatenate(([self._raw_step], steps[:-1]))  # a damaged number is a leap, a counter creeps
        wraps = np.flatnonzero((steps < 0) & (steps + period < window) & (np.abs(into) < window))
        self._raw_step = int(steps[-1])
        self._raw = int(raw[-1])
        out = raw + self._turns
        for i in wraps:
            out[i:] += period
            self._turns += period
            self._report.repair(
                "counter_rollover",
                f"{self._subject}the counter wrapped after {raw[i] - steps[i]}: {period} ticks added "
                "from here on",
                line=frame["line"][int(i)],
                subject=self._subject,
            )
        return out

    def _settle(
        self, frame: pl.DataFrame, ticks: Int64Array, steps: Int64Array, final: bool
    ) -> tuple[pl.DataFrame, Int64Array]:
        """Go through the monotone pieces between breaks; keep, drop, move or hold each."""
        lines = frame["line"].to_numpy()
        keep = np.ones(ticks.size, dtype=bool)
        breaks = np.flatnonzero((steps < 0) | (steps > self._jump))
        starts = [0, *(int(b) for b in breaks if b > 0)]
        ends = [*starts[1:], ticks.size]
        ticks = ticks.copy()
        last = self._last
        for a, b in zip(starts, ends, strict=True):
            upcoming = int(ticks[b]) if b < ticks.size else None
            short = b - a < SLIP_ROWS
            if upcoming is None and short and not final and a > 0:
                self._held = frame[a:].with_columns(t=pl.Series(ticks[a:] - self._shift))
                frame, ticks, keep = frame[:a], ticks[:a], keep[:a]
                break
            if self._stands_out(ticks[a:b], last, upcoming, short):
                keep[a:b] = False
                self._slip(ticks, lines, a, b, last if last is not None else upcoming)
                continue
            if last is not None and ticks[a] < last:
                back = int(np.searchsorted(ticks[a:b], last))
                if back < SLIP_ROWS:
                    keep[a : a + back] = False
                    self._slip(ticks, lines, a, a + back, last)
                    if back == b - a:
                        continue
                else:
                    move = last + (self._nominal or 1) - int(ticks[a])
                    self._report.repair(
                        "backwards_time",
                        f"{self._subject}the clock steps back by {self._text(last - int(ticks[a]))} and "
                        f"runs on from there: all rows from here on moved by {self._text(move)}",
                        rows=0,  # counted as they are handed out
                        line=lines[a],
                        subject=self._subject + "restart",
                    )
                    ticks[a:] += move
                    self._shift += move
            last = int(ticks[b - 1])
        frame, ticks = frame.filter(pl.Series(keep)), ticks[keep]
        return self._drop_repeats(frame, ticks)

    def _stands_out(self, piece: Int64Array, last: int | None, upcoming: int | None, short: bool) -> bool:
        """Whether a short piece lies ahead of both of its neighbours, or does not lead to what follows."""
        if not short or upcoming is None:
            return False
        if last is None:  # a first row whose time was cut, or damaged
            return upcoming < piece[-1] or (
                upcoming - piece[-1] > self._jump and self._is_cut(piece, upcoming)
            )
        return piece[0] - last > self._jump and last <= upcoming <= piece[-1]

    def _is_cut(self, piece: Int64Array, upcoming: int) -> bool:
        """Whether the only row of ``piece`` carries the last digits of the time that should stand there."""
        if piece.size != 1 or piece[0] < 0:
            return False
        nominal, digits = self._nominal or 1, int(piece[0])
        least, most = max(1, nominal // 2), 2 * nominal
        modulus = 10 ** len(str(digits))
        return (
            least + (upcoming - digits - least) % modulus <= most
        )  # the first distance with these last digits

    def _slip(self, ticks: Int64Array, lines: Int64Array, a: int, b: int, last: int | None) -> None:
        off = int(ticks[a]) - (last or 0)
        self._report.drop(
            "backwards_time",
            f"{self._subject}time is {self._text(abs(off))} {'ahead of' if off > 0 else 'before'} its "
            "neighbours: row dropped",
            count=b - a,
            line=lines[a],
            subject=self._subject,
        )

    def _drop_repeats(self, frame: pl.DataFrame, ticks: Int64Array) -> tuple[pl.DataFrame, Int64Array]:
        same = np.flatnonzero(
            np.diff(ticks, prepend=ticks[:1] - 1 if self._last is None else self._last) == 0
        )
        if not same.size:
            return frame, ticks
        data = _readings(frame)
        first = same[0] == 0  # its predecessor is in the block before
        later = same[1:] if first else same
        equal = np.zeros(same.size, dtype=bool)
        if later.size:
            pair = [
                data[c].gather(later).eq_missing(data[c].gather(later - 1)).to_numpy() for c in data.columns
            ]
            equal[1 if first else 0 :] = np.logical_and.reduce(pair) if pair else True
        if first:
            equal[0] = self._last_row is not None and data.row(0) == self._last_row
        lines = frame["line"]
        for kind, rows in (("duplicate_row", same[equal]), ("duplicate_time", same[~equal])):
            if not rows.size:
                continue
            line = lines[int(rows[0])]
            if kind == "duplicate_row":
                text = f"{self._subject}equals the row before, time included: dropped"
                self._report.drop(kind, text, count=rows.size, line=line, subject=self._subject)
            else:
                text = f"{self._subject}same time as the row before, other values: kept"
                self._report.note(kind, text, count=rows.size, line=line, subject=self._subject)
        keep = np.ones(ticks.size, dtype=bool)
        keep[same[equal]] = False
        return frame.filter(pl.Series(keep)), ticks[keep]

    def _measure(self, frame: pl.DataFrame, ticks: Int64Array) -> None:
        if not self._even or self._nominal is None:
            return
        steps = np.diff(ticks, prepend=ticks[:1] - self._nominal if self._last is None else self._last)
        odd = np.flatnonzero(np.abs(steps - self._nominal) > max(1.0, JITTER * self._nominal))
        odd = odd[steps[odd] > 0]
        gaps = steps[odd] > GAP * self._nominal
        for k, intervals in enumerate((odd[gaps], odd[~gaps])):
            if not intervals.size:
                continue
            self._counts[k] += intervals.size
            self._longest[k] = max(self._longest[k], int(steps[intervals].max()))
            if self._where[k] is None:
                self._where[k] = int(frame["line"][int(intervals[0])])

    def _summary(self) -> None:
        nominal = self._nominal or 1
        for k, kind in enumerate(("gap", "jitter")):
            if not self._counts[k]:
                continue
            text = (
                f"{self._subject}intervals {'above' if k == 0 else 'off the'} nominal {self._text(nominal)}"
                f"{'' if k == 0 else ' by more than 10 %'}, longest {self._text(self._longest[k])}: "
                "kept as they are"
            )
            lost = k == 0 and self._longest[0] > LONG_GAP * nominal
            say = self._report.loss if lost else self._report.note
            say(kind, text, count=self._counts[k], line=self._where[k], subject=self._subject)

    def _text(self, ticks: int) -> str:
        return f"{ticks * self._tick_ns / 1e6:g} ms"


def _readings(frame: pl.DataFrame) -> pl.DataFrame:
    """Return what a row says beside its time and place in the file."""
    return pl.DataFrame([s for s in frame.get_columns() if s.name not in ("t", "line")])
