"""The page of limits: every sentence names its test, and those tests are there."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from marcha.ingest import cells, optical, orientations, sensortables, text
from marcha.ingest.formats.sensor_logger import SensorLogger
from marcha.ingest.registry import make_options
from marcha.ingest.simulate import leg, simulate
from marcha.recording import MarchaError
from marcha.replay.trajectory import OutOfOrderError, in_order, stances_of, track_of, track_of_stream, way_of
from scipy.spatial.transform import Rotation

from . import (
    test_import_bids,
    test_import_leg_contracts,
    test_import_leg_formats,
    test_import_phone,
    test_import_phone_apps,
)
from .conftest import ROOT
from .contracts.importer import ImporterContract

PAGE = (ROOT / "docs" / "limits.md").read_text(encoding="utf-8")
SENTENCES = [line for line in PAGE.splitlines() if line.startswith("- ")]


@pytest.mark.parametrize("sentence", SENTENCES, ids=lambda s: s[2:60])
def test_a_sentence_has_a_test(sentence: str) -> None:
    match = re.fullmatch(r"- .*[.] `([\w/]+\.py)::([\w.]+)`", sentence)
    assert match is not None, "say the sentence, then its test"
    path, _, name = match[1], *match[2].rpartition(".")[1:]
    tree = ast.parse((ROOT / "tests" / Path(path)).read_text(encoding="utf-8"))
    assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


WINDOWED = [
    test_import_bids.TestBids,
    test_import_leg_contracts.TestViconCsv,
    test_import_leg_formats.TestAngles,
    test_import_leg_formats.TestTrc,
    test_import_phone_apps.TestSensorLogger,
]


@pytest.mark.parametrize("contract", WINDOWED, ids=lambda c: c.importer.name)
def test_a_table_is_read_in_windows(
    contract: type[ImporterContract], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first rows are there before the file is read, and the rows are the same."""
    test, read = contract(), text.read_blocks
    sample = test.sample(tmp_path)
    _, whole, report = test.read(sample, tmp_path)
    taken = 0

    def small(path: Path, size: int | None = None) -> Iterator[tuple[bytes, bool]]:
        nonlocal taken
        for piece in read(path, 2000):
            taken += 1
            yield piece

    for module in (text, cells):
        monkeypatch.setattr(module, "read_blocks", small)
    _, windowed, again = test.read(sample, tmp_path)
    # The nominal interval, to which gaps and jitter are compared, is that of the first piece.
    assert [f.kind for f in again.findings] == [f.kind for f in report.findings]
    assert (again.rows_kept, again.rows_dropped) == (report.rows_kept, report.rows_dropped)
    assert windowed.keys() == whole.keys()
    assert all(table.equals(whole[topic], null_equal=True) for topic, table in windowed.items())
    needed, taken = taken, 0
    monkeypatch.setattr(optical, "ROWS", 32)
    monkeypatch.setattr(optical, "HEAD_ROWS", 32)
    imported = test.importer.read([sample], make_options(test.importer, test.settings(tmp_path)))
    next(imported.blocks())
    assert taken < 0.6 * needed  # a file of several tables is gone through once before


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


@pytest.mark.parametrize("rows", [1, 7, 1000])
def test_a_way_read_in_pieces_is_that_of_the_track(rows: int) -> None:
    rng = np.random.default_rng(1)
    names = ["pos_x", "pos_y", "pos_z"]
    t_ns = np.arange(300) * 10**7 + 5 * 10**8
    table = pl.DataFrame({"t_ns": t_ns, **{n: rng.normal(size=300) for n in names}})
    table = table.with_columns(
        pl.when(pl.col("t_ns") % 13 == 0).then(float("nan")).otherwise("pos_y").alias("pos_y")
    )
    track = track_of(table)
    assert track is not None
    stances = np.array([[0, 1], [3, 55], [60, 60], [70, 140], [200, 220], [400, 500]]) * 10**7
    whole, last = way_of([track], stances, int(track.t_ns[-1])), track.t_ns[-1]
    way = way_of(in_order(pieces(table, rows)), stances)
    assert whole is not None
    assert way is not None
    assert np.array_equal(way.ends, track.position[[0, -1]])
    assert np.array_equal(way.ends, whole.ends)
    side = np.hypot(*np.diff(track.position[:, :2], axis=0).T)
    assert way.length_m == pytest.approx(side.sum())
    middles = [(50 + 55) / 2, 60, 105, 210]
    places = track.position[np.searchsorted(track.t_ns, np.array(middles) * 10**7), :2]
    assert way.stances_m == pytest.approx(np.hypot(*np.diff(places, axis=0).T).sum())
    assert whole.stances_m == pytest.approx(way.stances_m)
    beyond = np.vstack((stances[:5], [[last - 10**7, last + 10**9]]))
    assert way_of(in_order(pieces(table, rows)), beyond) is None  # its middle is known from the end alone
    ended = way_of([track], beyond, int(last))
    assert ended is not None
    assert ended.stances_m is not None
    assert ended.stances_m > (way.stances_m or 0.0)


def test_a_way_whose_time_repeats_is_not_read_in_pieces() -> None:
    table = pl.DataFrame({"t_ns": [0, 1, 1], **{f"pos_{a}": [0.0, 1.0, 2.0] for a in "xyz"}})
    with pytest.raises(OutOfOrderError):
        way_of(in_order([table]), np.empty((0, 2), np.int64))


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
        monkeypatch.setattr("marcha.replay.view.track_of_stream", None)  # the track is not held either
        evaluate(rec)
    read = {t.rpartition("/")[2] for t in asked if t.startswith("/estimate/")}
    assert not read & {"sigma", "pose", "velocity", "detector", "attitude"}, read


def test_a_capture_read_in_windows_has_the_angles_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is constant in it (clusters, sides, the main axis) is that of its first frames."""
    made = simulate("walking", tmp_path, seed=3, duration_s=30, sides="both", dropout_share=0.02)
    capture = [path for path in made.paths if path.suffix == ".trc"]
    test = test_import_leg_formats.TestTrc()
    _, whole, report = test.read(capture[0], tmp_path)
    monkeypatch.setattr(optical, "HEAD_ROWS", 1000)
    monkeypatch.setattr(optical, "ROWS", 300)
    _, windowed, again = test.read(capture[0], tmp_path)
    assert windowed.keys() == whole.keys()
    assert windowed["/reference/markers"].equals(whole["/reference/markers"], null_equal=True)
    assert [f.kind for f in again.findings] == [f.kind for f in report.findings]
    for topic in set(whole) - {"/reference/markers"}:
        assert windowed[topic].columns == whole[topic].columns
        assert windowed[topic]["t_ns"].equals(whole[topic]["t_ns"])
        off = windowed[topic].drop("t_ns").to_numpy() - whole[topic].drop("t_ns").to_numpy()
        assert np.nanmax(np.abs(off)) < np.radians(0.3)


@pytest.mark.parametrize("options", [{"flexion_axis": "x"}, {}], ids=["axis", "main axis"])
def test_angles_of_orientations_read_in_windows_are_those_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, str]
) -> None:
    """The sensors' files are read side by side; only the main axis is that of the first window."""
    capture = leg("walking", seed=3, duration_s=60, noise="mems")
    for segment in ("thigh", "shank"):
        quat = Rotation.from_matrix(capture.segments[segment].rot_ns).as_quat(scalar_first=True)
        table = {"PacketCounter": np.arange(len(quat))} | {f"Quat_q{k}": quat[:, k] for k in range(4)}
        body = pl.DataFrame(table).write_csv(separator="\t")
        (tmp_path / f"{segment}.txt").write_text(f"// Update Rate: {capture.options.rate_hz}Hz\n{body}")
    importer = test_import_leg_formats.TestXsensText.importer
    files = [tmp_path / "thigh.txt", tmp_path / "shank.txt"]

    def knee() -> np.ndarray:
        blocks = importer.read(files, make_options(importer, options)).blocks()
        return np.concatenate(
            [t["knee"].to_numpy() for topic, t in blocks if topic == orientations.DEVICE_TOPIC]
        )

    whole = knee()
    monkeypatch.setattr(orientations, "ROWS", 700)
    monkeypatch.setattr("marcha.ingest.formats.table.BLOCK_BYTES", 3000)
    assert np.abs(knee() - whole).max() < (1e-9 if options else np.radians(1.0))


def test_json_of_sensor_logger_is_read_whatever_its_objects_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[dict[str, Any]] = [
        {"sensor": "Gyroscope", "time": str(k * 10**7), "x": 0.1 * k, "y": k, "z": "1.5", "note": note}
        for k, note in enumerate(["}, {", [{"a": 1}, {"b": "},{"}], {"c": [{}, {}]}] * 40)
    ]
    rows[5]["x"], rows[9]["time"] = "none", "never"
    path = tmp_path / "log.json"
    path.write_text(json.dumps(rows))
    monkeypatch.setattr(sensortables, "BLOCK_BYTES", 100)
    monkeypatch.setattr(sensortables, "PIECE_ROWS", 50)
    _, tables, report = test_import_phone.read(SensorLogger(), path)
    expected = [0.1 * k for k in range(len(rows)) if k not in (5, 9)]
    assert tables["/phone/gyr"]["gyr_x"].drop_nans().to_list() == expected
    assert (test_import_phone.kinds(report)["bad_row"], report.rows_dropped) == (1, 1)
    path.write_text(json.dumps(rows)[:-30])
    with pytest.raises(MarchaError, match="not a whole JSON"):
        test_import_phone.read(SensorLogger(), path)
