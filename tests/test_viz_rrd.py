"""Saved views: what is in the .rrd equals what is in the recording."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import marcha.recording as mr
import marcha.replay as rp
import marcha.viz as viz
import numpy as np
import polars as pl
import pytest
import rerun as rr
from marcha.recording.errors import MarchaError, OutputExists, UsageError
from marcha.recording.provenance import hash_file
from marcha.recording.selection import Selection
from marcha.viz.timeaxis import SINCE_START, UTC
from marcha.viz.views.tracks import Sigma
from rerun.chunk import RrdReader

RUN = "foot_9iez_foot_imu1"
EPOCH = 1_700_000_000_000_000_000
START = 5_000_000_000
"""First time of the walk, by its device's clock."""


@pytest.fixture(autouse=True)
def _strict() -> Iterator[None]:
    """Misuse of Rerun raises instead of being logged."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def walk_tables(seed: int = 0, start_ns: int = 5_000_000_000) -> dict[str, tuple[str, pl.DataFrame]]:
    """Return a small walk: an IMU that rests, then swings eight times 1.2 m ahead (minimum jerk), and its
    truth."""
    rng = np.random.default_rng(seed)
    n = 2_400
    s = np.arange(n) / 200.0
    t_ns = start_ns + np.arange(n) * 5_000_000
    step = np.clip(np.floor(s - 2.5), -1, 8)
    u = np.clip((s - 2.5 - step) / 0.5, 0.0, 1.0) * (
        (step >= 0) & (step < 8)
    )  # swings of 0.5 s, once a second
    swing = (u > 0) & (u < 1)
    position = np.zeros((n, 3))
    position[:, 0] = 1.2 * (np.clip(step, 0, 8) + u**3 * (10 - 15 * u + 6 * u**2))
    position[:, 2] = 0.1 * np.sin(np.pi * u) ** 2 * swing
    force = np.gradient(np.gradient(position, s, axis=0), s, axis=0) + np.array([0.0, 0.0, 9.81])
    acc = force + 0.02 * rng.normal(size=(n, 3))
    gyr = 0.002 * rng.normal(size=(n, 3))
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))

    def table(**columns: np.ndarray) -> pl.DataFrame:
        return pl.DataFrame({"t_ns": t_ns, **columns})

    def xyz(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        return {f"{name}_{a}": values[:, i] for i, a in enumerate("xyz")}

    quat = {f"quat_{a}": identity[:, i] for i, a in enumerate("wxyz")}
    return {
        "/foot/imu1": ("sensor_msgs/msg/Imu", table(**xyz("acc", acc), **xyz("gyr", gyr))),
        "/foot/mag": ("sensor_msgs/msg/MagneticField", table(**xyz("mag", 5e-5 * np.ones((n, 3))))),
        "/foot/baro": ("sensor_msgs/msg/FluidPressure", table(pressure_pa=101_325.0 - s)),
        "/reference/pose": ("geometry_msgs/msg/PoseStamped", table(**xyz("pos", position), **quat)),
        "/reference/stance": ("marcha_msgs/msg/Stance", table(still=~swing)),
    }


def write_walk(path: Path, **options: int) -> mr.Recording:
    """Write that walk as a recording, with annotations."""
    annotations = pl.DataFrame(
        {
            "tier": ["surface", "surface"],
            "start_ns": [5_000_000_000, 9_000_000_000],
            "end_ns": [9_000_000_000, 12_000_000_000],
            "label": ["tiles", "grass"],
            "metadata": ["{}", "{}"],
        }
    )
    with mr.create(path) as out:
        for topic, (schema, table) in walk_tables(**options).items():
            out.add_table(topic, schema, table, frame_id="imu1")
        out.add_metadata("device", {"clock": "utc" if options.get("start_ns") else "device"})
        if not options:
            out.add_annotations(annotations)
    return mr.open(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a raw and a replayed recording and the view of each."""
    folder = tmp_path_factory.mktemp("viz")
    raw = write_walk(folder / "walk.mcap")
    live = viz.LiveSink(folder / "live.rrd")
    estimators = ["foot.9iez[detector=c1c2c3]", "shoe=foot.9iez[detector=shoe]"]
    rp.replay(raw, estimators, out=folder / "done.mcap", sinks=[live])
    viz.write_rrd(mr.open(folder / "done.mcap"), folder / "done.rrd")
    return folder


@pytest.fixture(scope="module")
def done(folder: Path) -> mr.Recording:
    return mr.open(folder / "done.mcap")


def column(path: Path, entity: str, component: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times (ns) and values (rows, k) of one temporal component, read by Rerun's own reader."""
    times, values = [], []
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if chunk.is_static or component not in batch.schema.names:
            continue
        times.append(batch.column(SINCE_START).cast("int64").to_numpy())
        rows = batch.column(component).to_pylist()
        values.append(np.array(rows, dtype=object if isinstance(rows[0][0], str) else float))
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], np.concatenate(values)[order]


def entities(path: Path) -> set[str]:
    return {e for e in RrdReader(path).store().schema().entity_paths() if not e.startswith("/__properties")}


def statics(path: Path, entity: str, component: str) -> list:
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if chunk.is_static and component in batch.schema.names:
            return batch.column(component).to_pylist()[-1]
    raise AssertionError(f"{entity} has no static {component}")


def test_signals_have_the_recordings_times_and_values(folder: Path, done: mr.Recording) -> None:
    imu = done.table("/foot/imu1")
    t_ns, acc = column(folder / "done.rrd", "/foot/imu1/acc", "Scalars:scalars")
    np.testing.assert_array_equal(t_ns, imu["t_ns"].to_numpy() - START)
    np.testing.assert_array_equal(acc, imu.select("acc_x", "acc_y", "acc_z").to_numpy())


def test_the_norm_is_the_norm(folder: Path, done: mr.Recording) -> None:
    gyr = done.table("/foot/imu1").select("gyr_x", "gyr_y", "gyr_z").to_numpy()
    _, norm = column(folder / "done.rrd", "/foot/imu1/gyr_norm", "Scalars:scalars")
    np.testing.assert_allclose(norm[:, 0], np.linalg.norm(gyr, axis=1), rtol=1e-14)


def test_magnetometer_and_pressure_are_shown_in_the_units_that_their_names_say(folder: Path) -> None:
    path = folder / "done.rrd"
    _, mag = column(path, "/foot/mag", "Scalars:scalars")
    _, pressure = column(path, "/foot/baro", "Scalars:scalars")
    assert mag[0] == pytest.approx([50.0] * 3)
    assert pressure[0] == pytest.approx([1013.25])
    assert statics(path, "/foot/mag", "SeriesLines:names")[0] == "magnetic field x (µT)"
    assert statics(path, "/foot/baro", "SeriesLines:names") == ["pressure (hPa)"]


def test_estimates_stand_at_the_time_that_they_speak_of(folder: Path, done: mr.Recording) -> None:
    pose = done.table(f"/estimate/{RUN}/pose", log_time=True)
    assert (pose["t_log_ns"] > pose["t_ns"]).any()  # the detector looks ahead
    t_ns, z = column(folder / "done.rrd", f"/run/{RUN}/height", "Scalars:scalars")
    np.testing.assert_array_equal(t_ns, pose["t_ns"].to_numpy() - START)
    np.testing.assert_array_equal(z[:, 0], pose["pos_z"].to_numpy())


def test_a_reference_s_height_begins_at_zero_as_the_estimates_do(tmp_path: Path) -> None:
    table = pl.DataFrame({"t_ns": np.arange(5) * 10**7, "pos_x": 0.0, "pos_y": 0.0})
    table = table.with_columns(
        pos_z=7.5 + pl.col("t_ns") / 1e9, quat_w=1.0, quat_x=0.0, quat_y=0.0, quat_z=0.0
    )
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/reference/pose", "geometry_msgs/msg/PoseStamped", table)
    viz.write_rrd(mr.open(tmp_path / "a.mcap"), tmp_path / "a.rrd")
    _, z = column(tmp_path / "a.rrd", "/reference/height", "Scalars:scalars")
    np.testing.assert_allclose(z[:, 0], [0.0, 0.01, 0.02, 0.03, 0.04], atol=1e-12)


def test_a_band_without_an_error_beside_it_fills_its_plot() -> None:
    sigma: Any = Sigma.__new__(Sigma)  # without a viewer's scene
    sigma.groups = {f"sigma_pos_{a}": (f"/run/r/sigma/pos_{a}", 1.0) for a in "xyz"}
    sigma.canvas = SimpleNamespace(columns=lambda *a: None, zoom={})
    sigma.widest, sigma.plane = 0.0, False
    t_ns = np.arange(3)
    sigma.draw(t_ns, pl.DataFrame({f"sigma_pos_{a}": [0.0, 0.01, 0.02] for a in "xyz"}))
    sigma.end()
    assert sigma.canvas.zoom["/run/r/sigma/pos_x"] == pytest.approx((-0.026, 0.026))


def test_every_sample_is_a_point_of_the_trail_and_a_pose_of_the_foot(
    folder: Path, done: mr.Recording
) -> None:
    pose = done.table(f"/estimate/{RUN}/pose")
    p = pose.select("pos_x", "pos_y", "pos_z").to_numpy()
    _, trail = column(folder / "done.rrd", f"/run/{RUN}/trail", "Points3D:positions")
    _, foot = column(folder / "done.rrd", f"/run/{RUN}/foot", "Transform3D:quaternion")
    np.testing.assert_array_equal(trail[:, 0, :], p.astype(np.float32))
    xyzw = pose.select("quat_x", "quat_y", "quat_z", "quat_w").to_numpy()
    np.testing.assert_array_equal(foot[:, 0, :], xyzw.astype(np.float32))


def test_the_whole_track_is_one_static_line(folder: Path, done: mr.Recording) -> None:
    p = done.table(f"/estimate/{RUN}/pose").select("pos_x", "pos_y", "pos_z").to_numpy()
    (line,) = statics(folder / "done.rrd", f"/run/{RUN}/track", "LineStrips3D:strips")
    np.testing.assert_array_equal(np.array(line), p.astype(np.float32).astype(float))


def test_lanes_hold_only_the_changes_and_end_with_the_recording(folder: Path, done: mr.Recording) -> None:
    still = done.table("/reference/stance")
    t_ns, state = column(folder / "done.rrd", "/reference/stance", "StateChange:state")
    change = np.flatnonzero(np.diff(still["still"].cast(int).to_numpy(), prepend=-1))
    np.testing.assert_array_equal(t_ns[:-1], still["t_ns"].to_numpy()[change] - START)
    assert state[:2, 0].tolist() == ["still", "moving"]
    assert state[-1, 0] == ""
    assert t_ns[-1] == done.table("/foot/imu1")["t_ns"].to_numpy().max() - START


def test_thresholds_are_lines_on_the_statistic_and_on_the_raw_norm(folder: Path, done: mr.Recording) -> None:
    found = entities(folder / "done.rrd")
    metadata = done.channels[f"/estimate/{RUN}/detector"].metadata
    low, high = float(metadata["threshold.acc_norm.min"]), float(metadata["threshold.acc_norm"])
    for base in ("/foot/imu1/acc_norm", f"/run/{RUN}/detector/acc_norm"):
        for value, entity in ((low, f"acc_norm.min_{low:g}"), (high, f"acc_norm_{high:g}")):
            path = next(
                e
                for e in found
                if e.startswith(f"{base}/threshold/") and e.replace("\\", "").endswith(entity)
            )
            t_ns, line = column(folder / "done.rrd", path, "Scalars:scalars")
            assert line[:, 0].tolist() == [value, value]
            assert t_ns[1] - t_ns[0] == pytest.approx(done.duration_s * 1e9, abs=1)


def test_sigma_is_a_band_about_zero(folder: Path, done: mr.Recording) -> None:
    sigma = done.table(f"/estimate/{RUN}/sigma")
    _, variance = column(folder / "done.rrd", f"/run/{RUN}/sigma/pos_x", "Measurements:variances")
    _, value = column(folder / "done.rrd", f"/run/{RUN}/sigma/att_z", "Measurements:variances")
    np.testing.assert_allclose(variance[:, 0], sigma["sigma_pos_x"].to_numpy() ** 2, rtol=1e-6)
    np.testing.assert_allclose(value[:, 0], np.degrees(sigma["sigma_att_z"].to_numpy()) ** 2, rtol=1e-6)


def write_sigma(path: Path, schema: str, table: pl.DataFrame) -> Path:
    """Write a recording with nothing but a run's standard deviations and return its saved view."""
    with mr.create(path) as out:
        out.add_table(f"/estimate/{RUN}/sigma", f"marcha_msgs/msg/{schema}", table, frame_id="nav")
    viz.write_rrd(mr.open(path), path.with_suffix(".rrd"))
    return path.with_suffix(".rrd")


def test_sigma_of_an_older_recording_looks_the_same(tmp_path: Path, done: mr.Recording) -> None:
    table = done.table(f"/estimate/{RUN}/sigma")
    old = write_sigma(tmp_path / "old.mcap", "NamedValues", table)
    new = write_sigma(tmp_path / "new.mcap", "NavigationSigma", table)
    assert entities(old) == entities(new)
    for what, title, unit in (("pos", "position", "m"), ("vel", "velocity", "m/s"), ("att", "attitude", "°")):
        for axis in "xyz":
            entity = f"/run/{RUN}/sigma/{what}_{axis}"
            for path in (old, new):
                assert statics(path, entity, "Measurements:names") == [f"±1σ {title} {axis}"]
                assert statics(path, entity, "Measurements:units") == [unit]
            for component in ("Measurements:variances", "Measurements:values"):
                for a, b in zip(column(old, entity, component), column(new, entity, component), strict=True):
                    np.testing.assert_array_equal(a, b)


def test_sigma_of_the_position_alone_has_a_band_for_nothing_else(tmp_path: Path, done: mr.Recording) -> None:
    table = done.table(f"/estimate/{RUN}/sigma").select("t_ns", "^sigma_pos_[xyz]$")
    path = write_sigma(tmp_path / "a.mcap", "NavigationSigma", table)
    base = f"/run/{RUN}/sigma/"
    assert {e.removeprefix(base) for e in entities(path) if e.startswith(base)} == {"pos_x", "pos_y", "pos_z"}


def test_steps_are_points_footprints_and_text(folder: Path, done: mr.Recording) -> None:
    step, pose = done.table(f"/estimate/{RUN}/step"), done.table(f"/estimate/{RUN}/pose")
    assert step.height == 8
    path = folder / "done.rrd"
    _, length = column(path, f"/run/{RUN}/step", "Scalars:scalars")
    np.testing.assert_array_equal(length[:, 0], step["length_m"].to_numpy())
    t_ns, prints = column(path, f"/run/{RUN}/footprints", "Points3D:positions")
    there = step.select(t_ns="end_ns").join(pose, on="t_ns").select("pos_x", "pos_y", "pos_z").to_numpy()
    np.testing.assert_array_equal(t_ns, step["end_ns"].to_numpy() - START)
    np.testing.assert_allclose(prints[:, 0, :], there, atol=1e-5)
    _, text = column(path, f"/log/step/{RUN}", "TextLog:text")
    assert f"step 0, {step['length_m'][0]:.2f} m" in text[0, 0]


def test_annotations_are_a_lane_without_a_gap_between_neighbours(folder: Path) -> None:
    t_ns, label = column(folder / "done.rrd", "/annotation/surface", "StateChange:state")
    assert label[:, 0].tolist() == ["tiles", "grass", ""]
    assert t_ns.tolist() == [0, 4_000_000_000, 7_000_000_000]


def test_stances_of_a_replay_are_not_drawn_twice(folder: Path) -> None:
    assert not any(RUN in e for e in entities(folder / "done.rrd") if e.startswith("/annotation"))


def test_the_error_is_what_the_evaluation_measures(folder: Path, done: mr.Recording) -> None:
    metrics = rp.evaluate(done, alignment="origin-yaw").runs[0].metrics
    t_ns, distance = column(folder / "done.rrd", f"/run/{RUN}/distance", "Scalars:scalars")
    _, error = column(folder / "done.rrd", f"/run/{RUN}/error", "Scalars:scalars")
    np.testing.assert_array_equal(t_ns, done.table(f"/estimate/{RUN}/pose")["t_ns"].to_numpy() - START)
    np.testing.assert_allclose(np.linalg.norm(error, axis=1), distance[:, 0], atol=1e-12)
    assert distance.max() == pytest.approx(metrics["position_error_max_m"], abs=1e-9)
    assert distance.mean() == pytest.approx(metrics["position_error_mean_m"], abs=1e-9)
    assert 0.0 < distance.max() < 0.2


def test_runs_are_shown_where_the_alignment_puts_them(folder: Path, done: mr.Recording) -> None:
    names = ["pos_x", "pos_y", "pos_z"]
    both = done.table(f"/estimate/{RUN}/pose").join(done.table("/reference/pose"), on="t_ns", suffix="_ref")
    track, truth = both.select(names).to_numpy(), both.select(f"{c}_ref" for c in names).to_numpy()
    (moved,) = statics(folder / "done.rrd", f"/run/{RUN}", "Transform3D:translation")
    (turned,) = statics(folder / "done.rrd", f"/run/{RUN}", "Transform3D:mat3x3")
    rotation = np.array(turned).reshape(3, 3).T  # Rerun's matrices are column-major
    _, distance = column(folder / "done.rrd", f"/run/{RUN}/distance", "Scalars:scalars")
    shown = track @ rotation.T + moved
    np.testing.assert_allclose(np.linalg.norm(shown - truth, axis=1), distance[:, 0], atol=1e-5)


def test_the_report_names_runs_metrics_and_parameters(folder: Path) -> None:
    (text,) = statics(folder / "done.rrd", "/report", "TextDocument:text")
    for word in ("# done.mcap", RUN, "closure_m", "sigma_acc", "/foot/imu1"):
        assert word in text


def test_metrics_and_truth_are_properties_of_the_recording(done: mr.Recording, tmp_path: Path) -> None:
    with mr.create(tmp_path / "known.mcap") as out:
        out.copy_from(done)
        out.add_metadata("truth", {"closed": "true", "steps": "16"})
    viz.write_rrd(mr.open(tmp_path / "known.mcap"), tmp_path / "known.rrd")
    found: dict[str, object] = {}
    for chunk in RrdReader(tmp_path / "known.rrd").stream().filter(content="/__properties/**"):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            what = str(chunk.entity_path).replace("\\ ", " ").removeprefix("/__properties/")
            found[f"{what}: {name.rpartition(':')[2]}"] = batch.column(name)[0].as_py()
    metrics = rp.evaluate(done).runs[0].metrics
    assert found[f"metrics {RUN}: ate_rmse_m"] == [pytest.approx(metrics["ate_rmse_m"])]
    assert found["truth: closed"] == ["true"]
    assert found["truth: steps"] == [16.0]


def test_the_same_file_gives_the_same_recording_and_a_part_another(
    done: mr.Recording, tmp_path: Path
) -> None:
    def identity(name: str, **options: object) -> str:
        viz.write_rrd(done, tmp_path / name, selection=Selection(**options) if options else None)  # type: ignore[arg-type]
        (entry,) = RrdReader(tmp_path / name).recordings()
        return entry.recording_id

    first, again = identity("a.rrd"), identity("b.rrd")
    assert first == again == hash_file(done.path)
    assert identity("c.rrd", topics=("/foot/imu1",)) not in (first, "")


def test_the_time_line_is_since_the_start(folder: Path) -> None:
    names = {n for c in RrdReader(folder / "done.rrd").stream() for n in c.timeline_names}
    assert names == {SINCE_START}


def test_rerun_finds_the_file_sound(folder: Path) -> None:
    for name in ("done.rrd", "live.rrd"):
        command = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(folder / name)]
        said = subprocess.run(command, capture_output=True, text=True)
        assert said.returncode == 0, said.stderr


def test_the_blueprint_is_in_the_file(folder: Path) -> None:
    for name in ("done.rrd", "live.rrd"):
        assert len(RrdReader(folder / name).blueprints()) >= 1


def test_live_shows_the_same_as_saved(folder: Path) -> None:
    here, there = entities(folder / "live.rrd"), entities(folder / "done.rrd")
    assert {e for e in there if not e.startswith(("/annotation", "/log/annotation"))} <= here
    for entity, component in (
        ("/foot/imu1/acc", "Scalars:scalars"),
        (f"/run/{RUN}/trail", "Points3D:positions"),
        (f"/run/{RUN}/stance", "StateChange:state"),
        (f"/run/{RUN}/footprints", "Points3D:positions"),
        (f"/run/{RUN}/error", "Scalars:scalars"),
    ):
        for a, b in zip(
            column(folder / "live.rrd", entity, component),
            column(folder / "done.rrd", entity, component),
            strict=True,
        ):
            np.testing.assert_array_equal(a, b, err_msg=entity)


def test_a_clock_of_the_epoch_has_dates_beside_the_time_since_the_start(tmp_path: Path) -> None:
    path = viz.write_rrd(write_walk(tmp_path / "utc.mcap", start_ns=EPOCH), tmp_path / "utc.rrd")
    t_ns, _ = column(path, "/foot/baro", "Scalars:scalars")
    assert t_ns[0] == 0
    chunks = RrdReader(path).stream().filter(content="/foot/baro")
    chunk = next(c for c in chunks if not c.is_static)
    schema = chunk.to_record_batch().schema
    assert str(schema.field(SINCE_START).type) == "duration[ns]"
    assert str(schema.field(UTC).type) == "timestamp[ns]"
    assert chunk.to_record_batch().column(UTC).cast("int64")[0].as_py() == EPOCH


def test_several_recordings_stand_below_their_names_from_a_common_start(folder: Path, tmp_path: Path) -> None:
    other = write_walk(tmp_path / "utc.mcap", start_ns=EPOCH)
    path = viz.write_rrd([mr.open(folder / "walk.mcap"), other], tmp_path / "both.rrd")
    for name in ("walk", "utc"):
        t_ns, _ = column(path, f"/{name}/foot/imu1/acc", "Scalars:scalars")
        assert t_ns[0] == 0


def test_positions_far_away_keep_their_centimetres(tmp_path: Path) -> None:
    n = 50
    east = 4_500_000.0 + 0.01 * np.arange(n)
    columns = {"pos_x": east, "pos_y": 0 * east, "pos_z": 0 * east}
    with mr.create(tmp_path / "far.mcap") as out:
        table = pl.DataFrame({"t_ns": np.arange(n) * 10**7, **columns})
        out.add_table("/reference/pose", "geometry_msgs/msg/PoseStamped", table)
    path = viz.write_rrd(mr.open(tmp_path / "far.mcap"), tmp_path / "far.rrd")
    _, trail = column(path, "/reference/trail", "Points3D:positions")
    np.testing.assert_allclose(np.diff(trail[:, 0, 0]), 0.01, atol=1e-4)


def test_missing_values_are_gaps(tmp_path: Path) -> None:
    tables = walk_tables()
    schema, imu = tables["/foot/imu1"]
    with mr.create(tmp_path / "acc.mcap") as out:
        out.add_table("/foot/imu1", schema, imu.select("t_ns", "acc_x", "acc_y", "acc_z"))
    path = viz.write_rrd(mr.open(tmp_path / "acc.mcap"), tmp_path / "acc.rrd")
    assert not any("gyr_norm/threshold" in e for e in entities(path))
    _, acc = column(path, "/foot/imu1/acc", "Scalars:scalars")
    np.testing.assert_array_equal(acc, imu.select("acc_x", "acc_y", "acc_z").to_numpy())


def test_a_selection_limits_topics_and_time(folder: Path, done: mr.Recording, tmp_path: Path) -> None:
    options = Selection(topics=("/foot/imu1",), start_ns=6_000_000_000, end_ns=7_000_000_000)
    (path,) = viz.RrdExporter().export(done, tmp_path / "part.rrd", options)
    t_ns, _ = column(path, "/foot/imu1/acc", "Scalars:scalars")
    assert (t_ns.min(), t_ns.max()) == (1_000_000_000, 1_995_000_000)
    assert not any(e.startswith("/run") for e in entities(path))


def test_an_unknown_topic_is_named(done: mr.Recording, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="/nothing"):
        viz.write_rrd(done, tmp_path / "x.rrd", selection=Selection(topics=("/nothing",)))
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_stays(done: mr.Recording, tmp_path: Path) -> None:
    path = tmp_path / "x.rrd"
    path.write_bytes(b"mine")
    with pytest.raises(OutputExists):
        viz.write_rrd(done, path)
    assert path.read_bytes() == b"mine"


def test_nothing_is_left_where_drawing_fails(
    done: mr.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise MarchaError("no")

    monkeypatch.setattr("marcha.viz.draw.report", broken)
    with pytest.raises(MarchaError, match="no"):
        viz.write_rrd(done, tmp_path / "x.rrd")
    assert list(tmp_path.iterdir()) == []


def test_a_file_cut_short_is_not_put_in_place(
    done: mr.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from marcha.viz import stream

    def cut(file: object) -> None:
        part: Path = file.part  # type: ignore[attr-defined]
        part.write_bytes(part.read_bytes()[:-200])
        whole(file)  # type: ignore[arg-type]

    whole = stream.check_whole
    monkeypatch.setattr(stream, "check_whole", cut)
    with pytest.raises(MarchaError, match="not written whole"):
        viz.write_rrd(done, tmp_path / "x.rrd")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_replay_leaves_no_view(folder: Path, tmp_path: Path) -> None:
    class Broken(rp.TableSink):
        def write(self, topic: str, table: pl.DataFrame) -> None:
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        rp.replay(
            mr.open(folder / "walk.mcap"),
            ["foot.9iez"],
            sinks=[viz.LiveSink(tmp_path / "x.rrd"), Broken()],
        )
    assert list(tmp_path.iterdir()) == []


def test_a_live_view_needs_somewhere_to_show() -> None:
    with pytest.raises(UsageError, match="needs a file"):
        viz.LiveSink()


def test_no_display_is_said(done: mr.Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(UsageError, match="--web"):
        viz.show(done)


def test_importing_viz_does_not_import_rerun() -> None:
    code = "import sys, marcha.viz; sys.exit('rerun' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_a_live_view_gathers_what_comes_within_a_tenth_of_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple[str, list[int]]] = []

    class Scene:
        def write(self, topic: str, table: pl.DataFrame) -> None:
            shown.append((topic, table["t_ns"].to_list()))

    sink = viz.LiveSink("never-written.rrd")
    monkeypatch.setattr(sink, "_begun", lambda t_ns: Scene())
    for t in [*range(0, 1_000_000_000, 10_000_000), 300_000_000]:  # 100 Hz, then a seek backwards
        for topic in ("/a", "/b"):
            sink.write(topic, pl.DataFrame({"t_ns": [t], "t_log_ns": [t]}))
    sink._send()
    assert len(shown) <= 30
    for topic in ("/a", "/b"):
        assert [t for name, times in shown if name == topic for t in times] == [
            *range(0, 1_000_000_000, 10_000_000),
            300_000_000,
        ]
    assert all(times == sorted(times) for _, times in shown)
