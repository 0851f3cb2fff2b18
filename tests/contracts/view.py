"""The contract of every view: inherit it, name the view and give rows of a channel that it draws."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import marcha.recording as mr
import polars as pl
import pytest
import rerun as rr
from marcha.viz.canvas import TABS, Canvas
from marcha.viz.stream import new_stream
from marcha.viz.timeaxis import SINCE_START, TimeAxis
from marcha.viz.views import View
from rerun.chunk import RrdReader

Rows = dict[str, list[tuple[int, Any]]]


class ViewContract:
    """Subclass as ``class TestMine(ViewContract)``, set ``view`` and override :meth:`table`.

    What it promises: it says what it draws and draws it; what it shows lies below its channel's entity or the
    log, has a panel, and stands at the times of the rows; cut into blocks it draws the same; missing values
    and an empty channel are no failure; the rows are left as they were.
    """

    view: ClassVar[type[View]]

    def table(self) -> tuple[str, str, pl.DataFrame]:
        """Return topic, message type and typical rows (at least 20)."""
        raise NotImplementedError

    def draw(self, folder: Path, table: pl.DataFrame, block: int = 1000) -> tuple[Rows, Canvas]:
        """Draw rows with the view alone; return by entity its times and component values, and the canvas."""
        topic, schema, _ = self.table()
        with mr.create(folder / "view.mcap", overwrite=True) as out:
            out.add_table(topic, schema, table)
        channel = mr.open(folder / "view.mcap").channels[topic]
        stream = new_stream()
        stream.set_sinks(rr.FileSink(folder / "view.rrd"))
        canvas = Canvas(stream, [channel], TimeAxis())
        drawn = self.view(canvas, channel)
        drawn.begin()
        for start in range(0, table.height, block):
            part = table.slice(start, block)
            t_ns = part["t_ns"].to_numpy()
            canvas.first_ns = canvas.first_ns if canvas.first_ns is not None else int(t_ns[0])
            canvas.last_ns = int(t_ns[-1])
            drawn.draw(t_ns, part)
        drawn.end()
        stream.flush()
        stream.disconnect()
        rows: Rows = {}
        for chunk in RrdReader(folder / "view.rrd").stream():
            if chunk.is_static or chunk.entity_path.startswith("/__"):
                continue
            batch = chunk.to_record_batch()
            times = batch.column(SINCE_START).cast("int64").to_pylist()
            names = [n for n in batch.schema.names if ":" in n and not n.startswith("rerun.")]
            values = zip(*(batch.column(n).to_pylist() for n in names), strict=True)
            rows.setdefault(chunk.entity_path, []).extend(zip(times, values, strict=True))
        return {entity: sorted(found, key=repr) for entity, found in rows.items()}, canvas

    def test_says_what_it_draws(self, tmp_path: Path) -> None:
        topic, schema, table = self.table()
        assert issubclass(self.view, View)
        assert self.view.title
        with mr.create(tmp_path / "a.mcap") as out:
            out.add_table(topic, schema, table)
        assert self.view.fits(mr.open(tmp_path / "a.mcap").channels[topic])

    def test_draws_and_every_entity_has_a_panel(self, tmp_path: Path) -> None:
        topic, _, table = self.table()
        rows, canvas = self.draw(tmp_path, table)
        assert rows
        assert canvas.entries
        shown = {e.path for e in canvas.entries}
        for entity in rows:
            assert any(entity == p or entity.startswith(p + "/") for p in shown), f"{entity} is in no panel"
            owner = canvas.group(topic).rpartition("/")[0] or "/"
            assert entity.startswith((owner, "/log")), f"{entity} lies outside of {owner}"
        for entry in canvas.entries:
            assert entry.panel
            assert entry.tab in TABS or entry.tab.strip()

    def test_stands_at_the_times_of_the_rows(self, tmp_path: Path) -> None:
        _, _, table = self.table()
        rows, _ = self.draw(tmp_path, table)
        times = {t for found in rows.values() for t, _ in found}
        low, high = int(table["t_ns"].min()), int(table["t_ns"].max())  # type: ignore[arg-type]
        assert low <= min(times)
        assert max(times) <= high

    @pytest.mark.parametrize("block", [1, 7])
    def test_blocks_may_be_cut_anywhere(self, tmp_path: Path, block: int) -> None:
        _, _, table = self.table()
        whole, _ = self.draw(tmp_path, table)
        cut, _ = self.draw(tmp_path, table, block)
        assert cut == whole

    def test_missing_values_are_no_failure(self, tmp_path: Path) -> None:
        _, _, table = self.table()
        self.draw(tmp_path, table.with_columns(pl.selectors.float() * float("nan")))

    def test_an_empty_channel_is_no_failure(self, tmp_path: Path) -> None:
        _, _, table = self.table()
        rows, _ = self.draw(tmp_path, table[:0])
        assert rows == {}

    def test_leaves_the_rows_alone(self, tmp_path: Path) -> None:
        _, _, table = self.table()
        before = table.clone()
        self.draw(tmp_path, table)
        assert table.equals(before, null_equal=True)
