"""Results: what a replay writes into the recording, its lineage, and the real estimators end to end."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.ingest.simulate import walk
from marcha.recording import MarchaError, OutputExists, Recording, UsageError
from marcha.replay import (
    Engine,
    LiveSource,
    ManualClock,
    RecordingSink,
    RecordingSource,
    TableSink,
    evaluate,
    plan_runs,
    replay,
)
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from .replay_helpers import ACC, IMU, Echo, Smoother, channel, same_bits

GYR = ("gyr_x", "gyr_y", "gyr_z")
POSE = ("pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z")
VEL = ("vel_x", "vel_y", "vel_z")
FOOT = ["foot.9iez", "foot.naive"]


def columns(names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    return {n: np.ascontiguousarray(values[:, i]) for i, n in enumerate(names)}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated closed walk of two sensors with its truth and an annotated task."""
    target = tmp_path_factory.mktemp("walk") / "walk.mcap"
    with mr.create(target) as out:
        times = walk("rectangle", seed=5).t_ns
        for sensor in (1, 2):
            w = walk("rectangle", seed=5, sensor=sensor)
            acc, gyr = w.measured()
            imu = pl.DataFrame({"t_ns": w.t_ns} | columns(ACC, acc) | columns(GYR, gyr))
            out.add_table(f"/foot/imu{sensor}", IMU, imu, frame_id=f"imu{sensor}", metadata={"range": "16 g"})
            if sensor == 1:
                truth = pl.DataFrame({"t_ns": w.t_ns} | columns(POSE, np.hstack((w.pos, w.quat_wxyz))))
                out.add_table("/reference/pose", "geometry_msgs/msg/PoseStamped", truth, frame_id="nav")
                speed = pl.DataFrame({"t_ns": w.t_ns} | columns(VEL, w.vel))
                out.add_table(
                    "/reference/velocity", "geometry_msgs/msg/Vector3Stamped", speed, frame_id="nav"
                )
        out.add_metadata("truth", {"closed": "true", "length_m": "22.1"})
        task = {"tier": ["task"], "start_ns": [times[500]], "end_ns": [times[1500]], "label": ["first half"]}
        out.add_annotations(pl.DataFrame(task))
    return target


@pytest.fixture(scope="module")
def done(path: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Recording]:
    target = tmp_path_factory.mktemp("done") / "done.mcap"
    result = replay(mr.open(path), FOOT, out=target)
    return result, mr.open(target)


def tables(result: Any) -> dict[str, pl.DataFrame]:
    return {run.outputs[name]: t for run in result.runs for name, t in run.tables.items()}


def test_raw_channels_are_the_same(path: Path, done: tuple[Any, Recording]) -> None:
    before, after = mr.open(path), done[1]
    for topic in before.channels:
        assert after.table(topic, log_time=True).equals(before.table(topic, log_time=True))
    assert after.channels["/foot/imu1"].metadata["range"] == "16 g"
    assert after.metadata["truth"] == before.metadata["truth"]


def test_estimates_in_the_file_are_those_in_memory(done: tuple[Any, Recording]) -> None:
    result, rec = done
    for topic, table in tables(result).items():
        written = rec.table(topic, log_time=True)
        assert same_bits({topic: written.select(table.columns)}, {topic: table.cast(dict(written.schema))})  # type: ignore[arg-type]


def test_other_tools_read_the_filters_standard_deviations_by_name(done: tuple[Any, Recording]) -> None:
    topic = "/estimate/foot_9iez_foot_imu1/sigma"
    table = done[1].table(topic)
    with done[1].path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [m for *_, m in reader.iter_decoded_messages(topics=[topic])]
    assert {m.header.frame_id for m in messages} == {"nav"}
    for key, field in {"pos": "position", "vel": "velocity", "att": "attitude"}.items():
        theirs = [[getattr(getattr(m, field), a) for a in "xyz"] for m in messages]
        ours = table.select(f"sigma_{key}_{a}" for a in "xyz").to_numpy()
        np.testing.assert_array_equal(np.array(theirs), ours)
        assert np.isfinite(ours).all()
        assert (ours[-1] > 0).all()


def test_a_detector_that_looks_ahead_is_logged_late(done: tuple[Any, Recording]) -> None:
    result, rec = done
    latency = int(result.runs[0].lineage["latency"])
    imu, pose = (
        rec.table("/foot/imu1")["t_ns"],
        rec.table("/estimate/foot_9iez_foot_imu1/pose", log_time=True),
    )
    first = int(imu.search_sorted(pose["t_ns"][0]))
    assert latency > 0
    assert pose["t_log_ns"][0] == imu[first + latency]
    assert pose["t_log_ns"][-1] == imu[-1]


def test_lineage_names_input_and_every_parameter(path: Path, done: tuple[Any, Recording]) -> None:
    record = done[1].metadata["run/foot_9iez_foot_imu2"]
    assert record["input_blake2b"] == hashlib.blake2b(path.read_bytes()).hexdigest()
    assert record["input_recording"] == "walk.mcap"
    assert record["estimator"] == "foot.9iez"
    assert record["version"].startswith("marcha ")
    assert f"numpy {np.__version__}" in record["environment"]
    assert record["input"] == "/foot/imu2"
    params = json.loads(record["params"])
    assert params["rate_hz"] == pytest.approx(100.0, rel=1e-3)
    assert params.keys() == {k.removeprefix("param.") for k in record if k.startswith("param.")}


def test_channels_say_where_they_come_from(done: tuple[Any, Recording]) -> None:
    found = done[1].channels["/estimate/foot_9iez_foot_imu1/detector"].metadata
    assert found["estimator"] == "foot.9iez"
    assert found["input"] == "/foot/imu1"
    assert any(k.startswith("threshold.") for k in found)


def test_stances_and_steps_become_annotations(done: tuple[Any, Recording]) -> None:
    result, rec = done
    run = result.runs[0]
    marks = rec.annotations
    still = run.tables["stance"].filter(pl.col("still"))["t_ns"].to_numpy()
    stances = marks.filter(pl.col("tier") == f"{run.run}/stance")
    inside = np.zeros(len(still), bool)
    for start, end in stances.select("start_ns", "end_ns").iter_rows():
        inside |= (still >= start) & (still <= end)
    assert inside.all()
    (source,) = stances["source"].unique()
    assert source.startswith("algorithm:foot.9iez@")
    steps = marks.filter(pl.col("tier") == f"{run.run}/step")
    assert steps.height == run.tables["step"].height == run.metrics["steps"]
    assert steps["end_ns"].to_list() == run.tables["step"]["end_ns"].to_list()


def test_steps_agree_with_the_simulated_swings(done: tuple[Any, Recording]) -> None:
    truth, found = walk("rectangle", seed=5).steps, done[0].runs[0].tables["step"]
    assert found.height == truth.height
    assert np.abs(found["length_m"].to_numpy() - truth["length_m"].to_numpy()).max() < 0.1
    assert np.abs(found["end_ns"].to_numpy() - truth["end_ns"].to_numpy()).max() < 0.25e9


def test_the_errors_are_those_of_the_filter(done: tuple[Any, Recording]) -> None:
    run = next(r for r in evaluate(done[1], alignment="origin-yaw").runs if r.run == "foot_9iez_foot_imu1")
    assert run.metrics["ate_rmse_m"] < 0.3
    assert run.metrics["closure_percent"] < 2.0
    assert run.metrics["distance_error_percent"] < 3.0
    assert run.dropped == 0
    assert run.alignment == "origin-yaw"
    naive = next(r for r in evaluate(done[1]).runs if r.run == "foot_naive_foot_imu1")
    assert naive.metrics["ate_rmse_m"] > 10 * run.metrics["ate_rmse_m"]


def test_annotated_intervals_are_measured_and_own_tiers_are_not(done: tuple[Any, Recording]) -> None:
    (part,) = evaluate(done[1]).runs[0].intervals
    assert (part.tier, part.label) == ("task", "first half")
    assert 0 < part.metrics["distance_m"] < 22


def test_metrics_in_memory_equal_those_of_the_file(
    path: Path, done: tuple[Any, Recording], tmp_path: Path
) -> None:
    result, rec = done
    from_file = {r.run: r.metrics for r in evaluate(rec).runs}
    assert {r.run: r.metrics for r in result.runs} == {
        run: pytest.approx(metrics, nan_ok=True, rel=1e-6) for run, metrics in from_file.items()
    }
    lean = replay(mr.open(path), ["foot.9iez"], out=tmp_path / "lean.mcap", keep_tables=False)
    assert lean.runs[0].tables == {}
    strict = {k: v for k, v in result.runs[0].metrics.items() if k != "run_time_s"}
    assert {k: lean.runs[0].metrics[k] for k in strict} == pytest.approx(strict)


# -- the same bits -------------------------------------------------------------------------------------------


def test_kernels_give_the_same_bits_per_sample(path: Path, done: tuple[Any, Recording]) -> None:
    assert same_bits(tables(replay(mr.open(path), FOOT, mode="sample", max_rows=500)), tables(done[0]))


def test_kernels_give_the_same_bits_at_another_speed(path: Path, done: tuple[Any, Recording]) -> None:
    paced = replay(mr.open(path), FOOT, speed=40.0, clock=ManualClock())
    assert same_bits(tables(paced), tables(done[0]))


def test_kernels_give_the_same_bits_after_seeks(path: Path, done: tuple[Any, Recording]) -> None:
    source = RecordingSource(mr.open(path), max_rows=300)
    sink = TableSink()
    engine = Engine(source, plan_runs(source, FOOT), sinks=[sink], checkpoint_s=2.0)
    for share in (0.7, 0.2, 0.21, 0.9, 0.0, 0.5):
        engine.seek(source.start_ns + int(share * (source.end_ns - source.start_ns)))
    engine.play()
    engine.finish()
    assert same_bits({t: sink.table(t) for t in tables(done[0])}, tables(done[0]))  # type: ignore[misc]


def test_a_sink_that_cannot_open_leaves_nothing_of_the_others(path: Path, tmp_path: Path) -> None:
    class Broken(TableSink):
        def open(self, plan: object) -> None:
            raise MarchaError("no viewer")

    source, out = RecordingSource(mr.open(path)), tmp_path / "new" / "out.mcap"
    out.parent.mkdir()
    with pytest.raises(MarchaError, match="no viewer"):
        Engine(source, plan_runs(source, FOOT), sinks=[RecordingSink(out, mr.open(path)), Broken()])
    assert not list(out.parent.iterdir())


def test_kernels_give_the_same_bits_live(path: Path, done: tuple[Any, Recording]) -> None:
    rec = mr.open(path)
    rate = f"{RecordingSource(rec).rate_hz('/foot/imu1')!r}"
    imus = [channel(f"/foot/imu{i}", IMU, (*ACC, *GYR), rate_hz=rate) for i in (1, 2)]
    messages = (
        (m.topic, m.t_ns, list(m.values.values())) for m in rec.messages(["/foot/imu1", "/foot/imu2"])
    )
    live = replay(LiveSource(imus, messages), ["foot.9iez"])
    wanted = {t: v for t, v in tables(done[0]).items() if t.startswith("/estimate/foot_9iez")}
    assert same_bits(tables(live), wanted)


# -- files ---------------------------------------------------------------------------------------------------


def test_a_live_replay_records_what_it_hears(tmp_path: Path) -> None:
    imu = channel("/foot/imu", IMU, ACC)
    messages = [("/foot/imu", 10**9 + k * 10**7, [float(k), 0.5, 9.8]) for k in range(500)]
    result = replay(LiveSource([imu], messages), [Smoother(3)], out=tmp_path / "live.mcap")
    rec = mr.open(tmp_path / "live.mcap")
    assert rec.table("/foot/imu")["acc_x"].to_list() == [float(k) for k in range(500)]
    assert rec.channels["/estimate/smoother_foot_imu/state"].count == 500
    assert result.output == tmp_path / "live.mcap"


def test_a_second_replay_keeps_the_first(path: Path, tmp_path: Path) -> None:
    replay(mr.open(path), [Echo()], inputs=["/foot/imu1"], out=tmp_path / "one.mcap")
    again = replay(mr.open(tmp_path / "one.mcap"), [Echo()], inputs=["/foot/imu1"], out=tmp_path / "two.mcap")
    assert [r.run for r in again.runs] == ["echo_foot_imu1_2"]
    both = mr.open(tmp_path / "two.mcap")
    first, second = (both.table(f"/estimate/echo_foot_imu1{n}/row") for n in ("", "_2"))
    assert first.equals(second)
    assert {"run/echo_foot_imu1", "run/echo_foot_imu1_2"} <= set(both.metadata)


def test_a_range_keeps_all_raw_messages(path: Path, tmp_path: Path) -> None:
    rec = mr.open(path)
    start, end = rec.start_ns + 10**9, rec.start_ns + 2 * 10**9
    replay(rec, [Echo()], start_ns=start, end_ns=end, out=tmp_path / "part.mcap")
    part = mr.open(tmp_path / "part.mcap")
    assert part.channels["/foot/imu1"].count == rec.channels["/foot/imu1"].count
    rows = part.table("/estimate/echo_foot_imu1/row")["t_ns"]
    assert start <= rows.min() and rows.max() < end  # type: ignore[operator]  # noqa: PT018
    assert part.metadata["run/echo_foot_imu1"]["range.start_ns"] == str(start)


def test_an_existing_output_is_refused_before_anything_runs(path: Path, tmp_path: Path) -> None:
    target = tmp_path / "there.mcap"
    target.write_bytes(b"precious")
    with pytest.raises(OutputExists):
        replay(mr.open(path), [Echo()], out=target)
    assert target.read_bytes() == b"precious"


def test_the_input_is_never_the_output(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(UsageError, match="in place"):
        replay(mr.open(path), [Echo()], out=path, overwrite=True)
    assert path.read_bytes() == before


class Failing(Echo):
    def step(self, row: np.ndarray) -> np.ndarray:
        if row[0] > 0.01 or self.__dict__.setdefault("rows", 0) > 1000:
            raise ZeroDivisionError("a bug")
        self.__dict__["rows"] += 1
        return row


def test_a_failure_leaves_the_old_output(path: Path, tmp_path: Path) -> None:
    target = tmp_path / "there.mcap"
    target.write_bytes(b"precious")
    with pytest.raises(ZeroDivisionError):
        replay(mr.open(path), [Failing()], out=target, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["there.mcap"]
    assert target.read_bytes() == b"precious"


@pytest.mark.parametrize("method", ["add_table", "add_metadata"])
def test_a_full_disk_is_told_and_leaves_nothing(
    path: Path, tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise MarchaError("out.mcap: no space left")

    rec = mr.open(path)
    monkeypatch.setattr(mr.Writer, method, full)
    with pytest.raises(MarchaError, match="no space"):
        replay(rec, [Echo()], out=tmp_path / "out.mcap", max_rows=50)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_without_estimates_says_what_to_do(path: Path) -> None:
    with pytest.raises(MarchaError, match="marcha replay"):
        evaluate(mr.open(path))


def test_estimates_of_other_programs_are_measured(path: Path, tmp_path: Path) -> None:
    rec = mr.open(path)
    with mr.create(tmp_path / "foreign.mcap") as out:
        out.copy_from(rec)
        out.add_table(
            "/estimate/theirs/pose", "geometry_msgs/msg/PoseStamped", rec.table("/reference/pose"), "nav"
        )
    (run,) = evaluate(mr.open(tmp_path / "foreign.mcap")).runs
    assert run.run == "theirs"
    assert run.metrics["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"runs": ["none"]}, "no run none"),
        ({"alignment": "best"}, "se3"),
        ({"reference": "/x"}, "/reference/pose"),
    ],
)
def test_evaluate_refuses(done: tuple[Any, Recording], options: Mapping[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        evaluate(done[1], **options)
