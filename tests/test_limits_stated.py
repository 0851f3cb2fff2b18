"""The page of limits: every sentence names its test, and those tests are there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from marcha.replay.trajectory import stances_of, track_of, track_of_stream

from .conftest import ROOT

PAGE = (ROOT / "docs" / "limits.md").read_text(encoding="utf-8")
SENTENCES = [line for line in PAGE.splitlines() if line.startswith("- ")]


@pytest.mark.parametrize("sentence", SENTENCES, ids=lambda s: s[2:60])
def test_a_sentence_has_a_test(sentence: str) -> None:
    match = re.fullmatch(r"- .*[.] `([\w/]+\.py)::([\w.]+)`", sentence)
    assert match is not None, "say the sentence, then its test"
    path, _, name = match[1], *match[2].rpartition(".")[1:]
    tree = ast.parse((ROOT / "tests" / Path(path)).read_text(encoding="utf-8"))
    assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def pieces(table: pl.DataFrame, rows: int) -> list[pl.DataFrame]:
    return [table.slice(k, rows) for k in range(0, table.height, rows)]


@pytest.mark.parametrize("headings", [False, True])
@pytest.mark.parametrize("rows", [1, 7, 1000])
def test_a_track_read_in_pieces_is_the_track_of_its_table(rows: int, headings: bool) -> None:
    rng = np.random.default_rng(1)
    names = ["pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"]
    table = pl.DataFrame({"t_ns": np.arange(300) * 10**7, **{n: rng.normal(size=300) for n in names}})
    table = table.with_columns(
        pl.when(pl.col("t_ns") % 13 == 0).then(float("nan")).otherwise("pos_y").alias("pos_y")
    )
    whole = track_of(table if headings else table.drop(names[3:]))
    streamed = track_of_stream(300, iter(pieces(table, rows)), headings)
    assert whole is not None
    assert streamed is not None
    assert np.array_equal(whole.t_ns, streamed.t_ns)
    assert np.array_equal(whole.position, streamed.position)
    assert (whole.quat_wxyz is None) == (streamed.quat_wxyz is None)
    if whole.quat_wxyz is not None and streamed.quat_wxyz is not None:
        assert np.array_equal(whole.quat_wxyz, streamed.quat_wxyz)


def test_a_track_whose_time_repeats_is_not_read_in_pieces() -> None:
    table = pl.DataFrame({"t_ns": [0, 1, 1], **{f"pos_{a}": [0.0, 1.0, 2.0] for a in "xyz"}})
    assert track_of_stream(3, iter([table]), False) is None


@pytest.mark.parametrize("rows", [1, 2, 5, 100])
def test_stances_read_in_pieces_are_those_of_the_table(rows: int) -> None:
    rng = np.random.default_rng(2)
    table = pl.DataFrame({"t_ns": np.arange(60) * 10, "still": rng.random(60) < 0.6})
    still, t_ns = table["still"].to_numpy(), table["t_ns"].to_numpy()
    edges = np.diff(still.astype(np.int8), prepend=np.int8(0), append=np.int8(0))
    expected = np.column_stack((t_ns[np.flatnonzero(edges == 1)], t_ns[np.flatnonzero(edges == -1) - 1]))
    assert np.array_equal(stances_of(iter(pieces(table, rows))), expected)


def test_a_walk_without_a_reference_is_measured_without_its_large_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A metric of joints or of places once read all standard deviations: 200 bytes a sample."""
    import marcha.recording as mr
    from marcha.ingest import convert
    from marcha.ingest.simulate import simulate
    from marcha.replay import evaluate, replay

    made = simulate("straight", tmp_path, seed=3, length_m=4).paths[0]
    (tmp_path / "log").mkdir()
    log = made.rename(tmp_path / "log" / made.name)  # away from its truth
    convert(log, tmp_path / "a.mcap")
    with mr.open(tmp_path / "a.mcap") as rec:
        replay(rec, ["foot.9iez"], out=tmp_path / "b.mcap", metrics=False)
    with mr.open(tmp_path / "b.mcap") as rec:
        asked: list[str] = []
        real = mr.Recording.table

        def table(self: mr.Recording, topic: str, *more: object, **named: object) -> pl.DataFrame:
            asked.append(topic)
            return real(self, topic, *more, **named)  # type: ignore[arg-type]

        monkeypatch.setattr(mr.Recording, "table", table)
        evaluate(rec)
    read = {t.rpartition("/")[2] for t in asked if t.startswith("/estimate/")}
    assert not read & {"sigma", "pose", "velocity", "detector", "attitude"}, read
