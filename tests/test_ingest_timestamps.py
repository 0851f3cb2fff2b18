"""Repair of time: what happens to each defect, in one piece and in blocks of any size."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import Report, ReportBuilder
from marcha.ingest.timestamps import SLIP_ROWS, TimestampRepair

MS = 1_000_000


def run(
    t: list[int], value: list[int] | None = None, block: int = 10**9
) -> tuple[list[int], list[int], Report]:
    """Feed ticks of 1 ms; return times in ms, the lines that were kept, and the report."""
    report = ReportBuilder()
    clock = TimestampRepair(report, tick_ns=MS, period=2**32)
    frame = pl.DataFrame(
        {"t": t, "line": np.arange(1, len(t) + 1), "v": value or list(range(len(t)))},
        schema={"t": pl.Int64, "line": pl.Int64, "v": pl.Int64},
    )
    parts = [clock.feed(frame[i : i + block]) for i in range(0, len(t), block)]
    parts.append(clock.feed(frame.clear(), final=True))
    out = pl.concat(parts)
    return (out["t_ns"] // MS).to_list(), out["line"].to_list(), report.build()


def kinds(report: Report) -> dict[str, int]:
    return {f.kind: f.count for f in report.findings}


def steady(n: int = 100, start: int = 1000) -> list[int]:
    return list(range(start, start + 10 * n, 10))


def test_steady_time_is_untouched() -> None:
    t, lines, report = run(steady())
    assert t == steady()
    assert lines == list(range(1, 101))
    assert report.findings == []
    assert not report.lossy


def test_rollover_is_unrolled() -> None:
    t = steady(100, 2**32 - 500)
    out, _, report = run([x % 2**32 for x in t])
    assert out == t
    assert kinds(report) == {"counter_rollover": 1}
    assert report.findings[0].first_line == 51
    assert report.rows_repaired == 1


def test_two_rollovers() -> None:
    t = [x * 3_000_000 for x in range(2**33 // 3_000_000 + 5)]  # 50 minutes a row
    out, _, report = run([x % 2**32 for x in t])
    assert out == t
    assert kinds(report)["counter_rollover"] == 2


def test_reboot_is_no_rollover() -> None:
    """From a large value to a small one: far more than an hour is missing to the counter's end."""
    out, lines, report = run(steady(60, 3_000_000_000) + steady(60, 5_000))
    assert kinds(report) == {"backwards_time": 1}
    assert len(lines) == 120
    assert out == steady(120, 3_000_000_000)
    assert report.rows_repaired == 60


def test_duplicate_row_is_dropped() -> None:
    t = steady()
    out, lines, report = run([*t[:50], t[49], *t[50:]], [*range(50), 49, *range(50, 100)])
    assert out == t
    assert 51 not in lines
    assert kinds(report) == {"duplicate_row": 1}
    assert report.rows_dropped == 1


def test_same_time_with_other_values_is_kept() -> None:
    t = steady()
    out, _, report = run([*t[:50], t[49], *t[50:]])
    assert len(out) == 101
    assert kinds(report) == {"duplicate_time": 1}
    assert not report.lossy


def test_swapped_rows() -> None:
    t = steady()
    t[40], t[41] = t[41], t[40]
    out, lines, report = run(t)
    assert lines == [x for x in range(1, 101) if x != 42]
    assert out == sorted(out)
    assert kinds(report)["backwards_time"] == 1
    assert report.rows_dropped == 1


@pytest.mark.parametrize("wrong", [0, 17, 1_000_000, 2**32 - 1])
def test_one_damaged_time(wrong: int) -> None:
    t = steady()
    t[60] = wrong
    out, lines, report = run(t)
    assert lines == [x for x in range(1, 101) if x != 61]
    assert out == [x for i, x in enumerate(steady()) if i != 60]
    assert kinds(report)["backwards_time"] == 1


def test_first_row_with_its_time_cut() -> None:
    out, lines, report = run([238, *steady(99, 53248)])  # 53238 lost its first digits
    assert lines[0] == 2
    assert out[0] == 53248
    assert report.rows_dropped == 1


def test_clock_set_back_for_good() -> None:
    t = steady(100) + steady(100, 1500)
    out, lines, report = run(t)
    assert len(lines) == 200
    assert out == steady(200)
    assert report.rows_repaired == 100
    assert next(f for f in report.findings if f.kind == "backwards_time").first_line == 101


def test_gap_and_jitter_are_told_apart() -> None:
    t = steady()
    late = [*t[:30], *(x + 4 for x in t[30:60]), *(x + 44 for x in t[60:])]
    out, _, report = run(late)
    assert out == late
    assert kinds(report) == {"gap": 1, "jitter": 1}
    assert not report.lossy


def test_bursty_stamps_are_no_jitter_of_a_slower_sensor() -> None:
    """Five in six intervals are 6 ticks, the sixth catches up: the sensor's own is 5, not 6."""
    t = (1000 + np.cumsum(np.tile([6, 6, 6, 6, 6, 1], 40))).tolist()
    out, _, report = run(t)
    assert out == t
    assert kinds(report)["bursty_stamps"] == 1
    (jitter,) = [f for f in report.findings if f.kind == "jitter"]
    assert "nominal 5 ms" in jitter.detail
    (finding,) = [f for f in report.findings if f.kind == "bursty_stamps"]
    assert "6 ms" in finding.detail
    assert "5 ms" in finding.detail


def test_lost_rows_are_not_bursts() -> None:
    t = np.cumsum(np.where(np.arange(200) % 5 == 0, 20, 10)).tolist()
    _, _, report = run(t)
    assert "bursty_stamps" not in kinds(report)
    (gap,) = [f for f in report.findings if f.kind == "gap"]
    assert "nominal 10 ms" in gap.detail


def test_long_gap_is_a_loss() -> None:
    t = steady(50) + steady(50, 1000 + 500 + 5000)
    out, _, report = run(t)
    assert out == t
    assert kinds(report) == {"gap": 1}
    assert report.lossy


DEFECT = st.tuples(
    st.sampled_from(["drop", "repeat", "swap", "wrong", "jump"]),
    st.integers(2, 250),
    st.integers(0, 2**32 - 1),
)


def damage(defects: list[tuple[str, int, int]]) -> list[int]:
    t = steady(300, 2**32 - 1200)
    for kind, at, value in defects:
        at = min(at, len(t) - 2)
        if kind == "drop":
            del t[at]
        elif kind == "repeat":
            t.insert(at, t[at])
        elif kind == "swap":
            t[at], t[at + 1] = t[at + 1], t[at]
        elif kind == "wrong":
            t[at] = value
        else:
            t[at:] = [x + value % 100_000 for x in t[at:]]
    return [x % 2**32 for x in t]


@given(st.lists(DEFECT, max_size=6), st.integers(1, 400))
def test_any_damage(defects: list[tuple[str, int, int]], block: int) -> None:
    t = damage(defects)
    out, lines, report = run(t, block=block)
    assert out == sorted(out)
    assert lines == sorted(set(lines))
    assert report.rows_read == len(t)
    assert report.rows_kept == len(out)
    if report.rows_dropped:
        assert {"backwards_time", "duplicate_row"} & set(kinds(report))


@given(st.lists(DEFECT, max_size=4), st.integers(60, 400))
def test_blocks_do_not_matter(defects: list[tuple[str, int, int]], block: int) -> None:
    """Where a block ends changes nothing, so long as a block shows more rows than a slip has."""
    assert block > 2 * SLIP_ROWS
    t = damage(defects)
    assert run(t, block=block)[:2] == run(t)[:2]
