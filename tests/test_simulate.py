"""The simulator: its truth is exact, its errors are what they say, its files are the device's."""

from __future__ import annotations

import re
import struct
import tomllib
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import convert
from marcha.ingest import simulate as sim
from marcha.ingest.simulate.gait import BALL, HEEL
from marcha.ingest.simulate.walks import BLOCK, make_options
from marcha.recording.errors import MarchaError, OutputExists, UsageError
from scipy.spatial.transform import Rotation

WALKS = [s for s in sim.SCENARIOS if s != "still"]
ROUGH = {"stance_roll_deg": 5, "strike_mm": 0.3, "roll_deg": 15}


def fine(scenario: str, sensor: int, rate: float, **options):
    """Return exact motion on a uniform grid of ``rate`` Hz."""
    made = sim.Simulation(scenario, 3, make_options(scenario, options))
    return made.motion(np.arange(0, made.gait.end_s, 1 / rate), sensor)


def strapdown(motion, dt: float, gravity: float = 9.81):
    """Integrate the samples at odd indices as mid-points of steps of 2 dt, starting from the truth."""
    rot = Rotation.from_quat(motion.quat_wxyz[0], scalar_first=True).as_matrix()
    turns = Rotation.from_rotvec(motion.gyr_b[1::2] * 2 * dt).as_matrix()
    halves = Rotation.from_rotvec(motion.gyr_b[1::2] * dt).as_matrix()
    vel, pos = motion.vel[0].copy(), motion.pos[0].copy()
    out = []
    for turn, half, force in zip(turns, halves, motion.acc_b[1::2], strict=True):
        acc = rot @ half @ force - [0, 0, gravity]
        rot = rot @ turn
        pos = pos + vel * 2 * dt + acc * 2 * dt * dt
        vel = vel + acc * 2 * dt
        out.append(pos)
    return np.array(out), rot


@pytest.mark.parametrize("scenario", WALKS)
@pytest.mark.parametrize("style", [{}, {"heel_toe_roll": False}, ROUGH], ids=["default", "no-roll", "rough"])
def test_ideal_readings_integrate_to_the_trajectory(scenario: str, style: dict) -> None:
    motion = fine(scenario, 2, 2000, length_m=6, stair_steps=4, rest_s=0.5, **style)
    pos, rot = strapdown(motion, 1 / 2000)
    truth = motion.pos[2::2]
    most = 3e-3 if scenario == "lift" else 2e-3  # the longest of them, with two rides
    assert np.abs(pos[: len(truth)] - truth).max() < most
    end = Rotation.from_quat(motion.quat_wxyz[2::2][-1], scalar_first=True).as_matrix()
    assert np.degrees(np.arccos(np.clip((np.trace(rot.T @ end) - 1) / 2, -1, 1))) < 0.05


@pytest.mark.parametrize("scenario", WALKS)
def test_velocity_is_the_derivative_of_position_and_force_is_continuous(scenario: str) -> None:
    motion = fine(scenario, 1, 5000, **ROUGH)
    slope = (motion.pos[2:] - motion.pos[:-2]) * 2500
    assert np.abs(slope - motion.vel[1:-1]).max() < 1e-3
    assert np.abs(np.diff(motion.acc_b, axis=0)).max() < 2.0  # no jump: 0.2 ms of the steepest flank
    assert np.abs(np.diff(motion.gyr_b, axis=0)).max() < 0.05


@pytest.mark.parametrize("scenario", WALKS)
def test_a_standing_foot_does_not_move_and_a_walking_one_moves_like_a_foot(scenario: str) -> None:
    w = sim.walk(scenario)
    speed = np.linalg.norm(w.vel, axis=1)
    assert not w.vel[w.still].any()
    assert np.degrees(np.abs(w.gyr_b[w.still]).max()) < 1e-9
    assert w.still[: 3 * 95].all()
    assert w.still[-3 * 95 :].all()
    assert 0.3 < w.still.mean() < 0.6
    assert (2 if scenario == "stairs" else 4) < speed.max() < 5.2
    assert 250 < np.degrees(np.linalg.norm(w.gyr_b, axis=1)).max() < 600
    assert np.linalg.norm(w.acc_b, axis=1).max() > 20


@pytest.mark.parametrize("scenario", ["rectangle", "straight", "figure-eight"])
def test_the_sole_stays_on_or_above_the_ground(scenario: str) -> None:
    for point in (BALL, HEEL):
        w = sim.walk(scenario, mount1=sim.Mount(lever_m=tuple(point)))
        height = w.pos[:, 2] - w.pos[0, 2]
        assert height.min() > -0.01
        assert 0.05 < height.max() < 0.4


@pytest.mark.parametrize(
    ("scenario", "length", "turned_deg"),
    [("rectangle", 22.1, -270), ("figure-eight", 25.0, 0), ("stairs", 2 * 12 * 0.29 + 1.6, -270)],
)
def test_closed_walks_close_and_have_their_length(scenario: str, length: float, turned_deg: float) -> None:
    w = sim.walk(scenario)
    assert w.closed
    assert np.linalg.norm(w.pos[-1] - w.pos[0]) < 1e-9
    assert w.length_m == pytest.approx(length, rel=2e-3)
    assert w.steps["length_m"].sum() == pytest.approx(w.length_m)
    psi = np.unwrap(Rotation.from_quat(w.quat_wxyz, scalar_first=True).as_euler("ZYX")[w.still][:, 0])
    assert np.degrees(psi[-1] - psi[0]) == pytest.approx(turned_deg, abs=1e-6)


def test_three_laps_are_three_times_as_long_and_close() -> None:
    w = sim.walk("rectangle", laps=3, length_m=30)
    assert w.length_m == pytest.approx(90)
    assert np.linalg.norm(w.pos[-1] - w.pos[0]) < 1e-9


@pytest.mark.parametrize(("direction", "height"), [("up", 2.04), ("down", -2.04), ("up-down", 0.0)])
def test_stairs_climb(direction: str, height: float) -> None:
    w = sim.walk("stairs", direction=direction)
    assert w.pos[-1, 2] == pytest.approx(height, abs=1e-9)
    assert np.abs(w.pos[:, 2]).max() > 2.0
    assert w.steps["height_m"].sum() == pytest.approx(height, abs=1e-9)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_the_foot_passes_over_the_edge_of_the_steps(direction: str) -> None:
    w = sim.walk("stairs", direction=direction, heel_toe_roll=False)
    low, high = sorted((0.0, 2 * 0.17))
    for start, end in w.steps.select("start_ns", "end_ns").rows():
        swing = w.pos[(w.t_ns >= start) & (w.t_ns <= end)]
        half = np.argmin(np.abs(swing[:, 0] - (swing[0, 0] + swing[-1, 0]) / 2))
        assert swing[half, 2] - min(swing[0, 2], swing[-1, 2]) > low + 0.8 * (high - low)


def test_still_never_moves_and_reads_gravity() -> None:
    w = sim.walk("still", duration_s=12)
    assert w.t[-1] == pytest.approx(12, abs=0.02)
    assert w.still.all()
    assert not w.vel.any()
    assert not w.gyr_b.any()
    np.testing.assert_allclose(np.linalg.norm(w.acc_b, axis=1), 9.81)


def test_rest_reads_the_roll_and_pitch_of_the_mount() -> None:
    w = sim.walk("straight", sensor=2)
    x, y, z = w.acc_b[0]
    assert np.degrees(np.arctan2(y, z)) == pytest.approx(7.2)
    assert np.degrees(np.arctan2(-x, np.hypot(y, z))) == pytest.approx(32.7)


def test_steps_are_the_moving_stretches() -> None:
    w = sim.walk("rectangle", rate_hz=1000, late_share=0)
    edges = np.flatnonzero(np.diff(w.still.astype(int)))
    lifts, lands = w.t_ns[edges[::2]], w.t_ns[edges[1::2]]
    assert len(w.steps) == len(lifts) == 16
    assert np.abs(w.steps["start_ns"].to_numpy() - lifts).max() <= 2_000_000
    assert np.abs(w.steps["end_ns"].to_numpy() - lands).max() <= 2_000_000


def test_seed_decides_everything() -> None:
    a, b, c = (sim.walk("rectangle", seed=s) for s in (7, 7, 8))
    np.testing.assert_array_equal(a.measured(), b.measured())
    np.testing.assert_array_equal(a.t_ns, b.t_ns)
    assert a.steps["length_m"].to_list() != c.steps["length_m"].to_list()


def test_switching_one_error_leaves_the_others() -> None:
    noisy, quiet = sim.walk("straight"), sim.walk("straight", gyr_noise=0, drop_share=0.1)
    np.testing.assert_array_equal(noisy.t_ns, quiet.t_ns)
    np.testing.assert_array_equal(noisy.acc_b, quiet.acc_b)
    np.testing.assert_array_equal(noisy.measured()[0], quiet.measured()[0])
    assert (noisy.measured()[1] != quiet.measured()[1]).any()


def test_no_errors_means_the_ideal_readings() -> None:
    w = sim.walk("straight", errors="none")
    acc, gyr = w.measured()
    np.testing.assert_array_equal(acc, w.acc_b)
    np.testing.assert_array_equal(gyr, w.gyr_b)


def test_errors_have_their_size() -> None:
    w = sim.walk("still", duration_s=400, late_share=0)
    errors = sim.ImuErrors(
        acc_bias=(0.1, -0.2, 0.3),
        gyr_bias=(0.01, 0.02, -0.03),
        acc_bias_sigma=0,
        gyr_bias_sigma=0,
        acc_bias_walk=0,
        gyr_bias_walk=0,
        acc_noise=0.004,
        gyr_noise=0.0003,
        acc_scale=(0.01, -0.02, 0.03),
        gyr_misalignment=(0.0, 0.0, 0.02),
        quantize=False,
    )
    acc, gyr = w.measured(errors)
    expected = w.acc_b[0] * (1 + np.array(errors.acc_scale)) + errors.acc_bias
    np.testing.assert_allclose(acc.mean(0), expected, atol=4 * 0.04 / np.sqrt(len(acc)))
    np.testing.assert_allclose(gyr.mean(0), errors.gyr_bias, atol=4 * 0.003 / np.sqrt(len(gyr)))
    np.testing.assert_allclose(acc.std(0), 0.004 * np.sqrt(100), rtol=0.03)  # density · √rate
    np.testing.assert_allclose(gyr.std(0), 0.0003 * np.sqrt(100), rtol=0.03)
    moving = sim.walk("straight")
    turned = (0.01, -0.03, 0.02)
    tilted = moving.measured(sim.ImuErrors(**{**_off(), "gyr_misalignment": turned}))[1]
    np.testing.assert_allclose(tilted - moving.gyr_b, np.cross(turned, moving.gyr_b), atol=1e-12)


def _off() -> dict:
    return {f: getattr(sim.IDEAL, f) for f in sim.ImuErrors.__struct_fields__}


def test_turn_on_bias_and_random_walk_have_their_size() -> None:
    drawn, drift = [], []
    for seed in range(60):
        w = sim.walk("still", seed=seed, duration_s=25, late_share=0)
        errors = sim.ImuErrors(**{**_off(), "acc_bias_sigma": 0.03, "gyr_bias_walk": 1e-3})
        acc, gyr = w.measured(errors)
        drawn.append(acc[0] - w.acc_b[0])
        drift.append(gyr[-1])
    assert np.std(drawn) == pytest.approx(0.03, rel=0.2)
    assert np.std(drift) == pytest.approx(1e-3 * np.sqrt(25), rel=0.2)


@pytest.mark.parametrize("config", ["0000", "2301", "3333"])
def test_readings_are_whole_counts_clipped_at_the_full_scale(config: str) -> None:
    for sensor in (1, 2):
        w = sim.walk("straight", sensor=sensor, config=config)  # type: ignore[arg-type]
        a, g = (int(c) for c in config[2 * sensor - 2 : 2 * sensor])
        acc, gyr = w.measured()
        acc_counts = acc / 9.80665 * [16384, 8192, 4096, 2048][a]
        gyr_counts = np.degrees(gyr) * [131, 65.5, 32.8, 16.4][g]
        for counts in (acc_counts, gyr_counts):
            np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
            assert counts.min() > -32768.001
            assert counts.max() < 32767.001
        assert (np.abs(acc_counts) > 32766.5).any() == (a == 0)
        assert (np.abs(gyr_counts) > 32766.5).any() == (g == 0)


ROW = re.compile(rb"(?m)^\d+(?:,-?\d+){12}\r\n\r\n")


def rows_of(path: Path) -> np.ndarray:
    """Read the device's text without any of our code."""
    text = path.read_bytes()
    assert b"".join(ROW.findall(text)) == text
    return np.array([line.split(b",") for line in text.split(b"\r\n\r\n") if line], dtype=np.int64)


def test_text_is_the_devices_and_holds_the_measured_counts(tmp_path: Path) -> None:
    done = sim.simulate("rectangle", tmp_path, seed=5, config="2313")
    assert done.paths == [tmp_path / "conf-2313-rectangle-005.csv"]
    rows = rows_of(done.paths[0])
    assert len(rows) == done.rows
    for sensor, acc_lsb, gyr_lsb in ((1, 4096, 16.4), (2, 8192, 16.4)):
        w = sim.walk("rectangle", seed=5, config="2313", sensor=sensor)  # type: ignore[arg-type]
        acc, gyr = w.measured()
        np.testing.assert_array_equal(rows[:, 0], w.t_ns // 1_000_000)
        np.testing.assert_allclose(
            rows[:, 6 * sensor - 5 : 6 * sensor - 2], acc / 9.80665 * acc_lsb, atol=1e-6
        )
        np.testing.assert_allclose(
            rows[:, 6 * sensor - 2 : 6 * sensor + 1], np.degrees(gyr) * gyr_lsb, atol=1e-6
        )


def test_truth_files_hold_the_walk(tmp_path: Path) -> None:
    done = sim.simulate("figure-eight", tmp_path, seed=2, imu1={"gyr_bias": [0.1, 0, 0]}, gyr_bias_sigma=0)
    for sensor, path in ((1, done.truth[0]), (2, done.truth[1])):
        w = sim.walk("figure-eight", seed=2, sensor=sensor)  # type: ignore[arg-type]
        table = pl.read_csv(path)
        columns = "t_ns pos_x pos_y pos_z quat_w quat_x quat_y quat_z vel_x vel_y vel_z still"
        assert table.columns == columns.split()
        np.testing.assert_array_equal(table["t_ns"], w.t_ns)
        whole = np.column_stack((w.pos, w.quat_wxyz, w.vel, w.still))
        np.testing.assert_allclose(table.drop("t_ns").to_numpy(), whole, atol=1e-12)
    facts = tomllib.loads(done.truth[2].read_text(encoding="utf-8"))
    assert facts["closed"] is True
    assert facts["length_m"] == pytest.approx(25.0, rel=2e-3)
    assert (facts["scenario"], facts["seed"], facts["options"]["rate_hz"]) == ("figure-eight", 2, 100)
    assert facts["imu1"]["turn_on_gyr_bias"] == [0.1, 0, 0]


def test_equal_calls_write_equal_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        sim.simulate("straight", tmp_path / folder, seed=4, drop_share=0.05, duplicate_share=0.05)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_line_defects(tmp_path: Path) -> None:
    plain = sim.simulate("straight", tmp_path).paths[0].read_bytes()
    done = sim.simulate("straight", tmp_path, name="x", boot_chatter=True, cut_first=True, cut_last=True)
    text = done.paths[0].read_bytes()
    assert text.startswith(b"Initializing I2C...\r\n")
    body = text[text.index(b"MPU-02 ready\r\n") + len(b"MPU-02 ready\r\n") :]
    assert body in plain
    first, last = body.split(b"\r\n\r\n")[0], body.rsplit(b"\r\n\r\n")[-1]
    assert 0 < first.count(b",") < 12
    assert 0 < last.count(b",") < 12


def test_wall_clock_prefix_runs_with_the_rows(tmp_path: Path) -> None:
    lines = sim.simulate("straight", tmp_path, wall_clock=True).paths[0].read_bytes().split(b"\r\n\r\n")[:-1]
    parsed = [re.fullmatch(rb"(\d\d):(\d\d):(\d\d)\.(\d{3}) (\d+),.*", line) for line in lines]
    wall = [((int(m[1]) * 60 + int(m[2])) * 60 + int(m[3])) * 1000 + int(m[4]) for m in parsed if m]
    stamp = [int(m[5]) for m in parsed if m]
    assert len(stamp) == len(lines)
    np.testing.assert_array_equal(np.diff(wall), np.diff(stamp))


def test_millis_roll_over_and_truth_does_not(tmp_path: Path) -> None:
    done = sim.simulate("straight", tmp_path, start_ms=2**32 - 5000)
    stamp = rows_of(done.paths[0])[:, 0]
    assert stamp[0] == 2**32 - 5000
    assert stamp.max() < 2**32
    assert (np.diff(stamp) < 0).sum() == 1
    truth = pl.read_csv(done.truth[0])["t_ns"].to_numpy() // 1_000_000
    np.testing.assert_array_equal(truth % 2**32, stamp)
    assert (np.diff(truth) > 0).all()


def test_late_dropped_and_doubled_rows(tmp_path: Path) -> None:
    late = sim.walk("straight", duration_s=300, late_share=0.01, late_max_ms=14)
    step = np.diff(late.t_ns) // 1_000_000
    assert set(step) <= set(range(10, 25))
    assert (step > 10).mean() == pytest.approx(0.01, rel=0.3)
    done = sim.simulate("straight", tmp_path, duration_s=300, drop_share=0.1, duplicate_share=0.2)
    rows = rows_of(done.paths[0])
    kept = np.unique(rows, axis=0)
    total = len(pl.read_csv(done.truth[0]))
    assert len(kept) / total == pytest.approx(0.9, abs=0.01)
    assert len(rows) / len(kept) == pytest.approx(1.2, abs=0.01)


def test_packets_are_28_bytes_big_endian(tmp_path: Path) -> None:
    done = sim.simulate("straight", tmp_path, format="packets")
    rows = rows_of(sim.simulate("straight", tmp_path / "text").paths[0])
    raw = done.paths[0].read_bytes()
    packets = list(struct.iter_unpack(">cBI4h3h3h2s", raw))
    assert len(packets) == 2 * len(rows)
    assert {(p[0], p[1], p[-1]) for p in packets} == {(b"$", 1, b"\r\n"), (b"$", 2, b"\r\n")}
    first, second = (np.array([p[2:-1] for p in packets if p[1] == k]) for k in (1, 2))
    np.testing.assert_array_equal(first[:, [0, *range(5, 11)]], rows[:, :7])
    np.testing.assert_array_equal(second[:, 5:], rows[:, 7:])
    w = sim.walk("straight")
    np.testing.assert_allclose(first[:, 1:5] / 16384, w.quat_wxyz, atol=1 / 16384)


def test_a_long_walk_is_made_in_blocks_with_one_clock() -> None:
    made = sim.Simulation("rectangle", 0, make_options("rectangle", {"duration_s": 1500}))
    blocks = list(made.times())
    assert len(blocks) == 3
    assert max(len(b) for b in blocks) == BLOCK
    step = np.diff(np.concatenate(blocks))
    assert step.min() == pytest.approx(0.01)
    assert step.max() < 0.0241
    assert made.gait.end_s >= 1480


def test_an_existing_output_is_refused_and_stays(tmp_path: Path) -> None:
    done = sim.simulate("straight", tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    done.paths[0].unlink()
    with pytest.raises(OutputExists, match=r"truth\.csv: exists already"):
        sim.simulate("straight", tmp_path, laps=2)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {
        k: v for k, v in before.items() if k != done.paths[0].name
    }
    sim.simulate("straight", tmp_path, laps=2, overwrite=True)
    assert done.truth[0].read_bytes() != before[done.truth[0].name]


def test_a_failure_in_mid_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("marcha.ingest.simulate.writer._facts", full)
    with pytest.raises(MarchaError, match="No space left on device; nothing was written"):
        sim.simulate("straight", tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("scenario", "options", "words"),
    [
        ("moon", {}, "rectangle, straight"),
        ("straight", {"lapse": 2}, "lapse"),
        ("straight", {"laps": 0}, "laps"),
        ("straight", {"imu1.gyr_noise": -1}, "gyr_noise"),
        ("straight", {"config": "4444"}, "config"),
        ("straight", {"laps": 2, "duration_s": 60}, "exclude each other"),
        ("straight", {"format": "wav"}, "text or packets"),
        ("straight", {"format": "packets", "cut_first": True}, "only text"),
        ("stairs", {"direction": "sideways"}, "direction"),
    ],
)
def test_a_wrong_call_is_one_line(scenario: str, options: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words) as caught:
        sim.simulate(scenario, tmp_path, **options)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_options_come_as_text_too() -> None:
    a = make_options(
        "straight",
        {
            "laps": "2",
            "imu1.acc_scale": np.array([0.1, 0, 0]),
            "imu2.gyr_bias": "0.1,0,0",
            "stance_roll_deg": "5",
            "clip": "false",
        },
    )
    assert (a.laps, a.imu(2).gyr_bias, a.style.stance_roll_deg) == (2, (0.1, 0, 0), 5)
    assert not a.imu(1).clip
    assert a.imu(1).gyr_bias == sim.Options().imu(1).gyr_bias


@given(
    scenario=st.sampled_from(WALKS),
    seed=st.integers(0, 2**31),
    stride_s=st.floats(0.6, 2.0),
    stride_m=st.floats(0.5, 2.0),
    rate_hz=st.floats(25, 400),
    laps=st.integers(1, 3),
)
def test_any_walk_stands_on_its_footfalls(
    scenario: str, seed: int, stride_s: float, stride_m: float, rate_hz: float, laps: int
) -> None:
    w = sim.walk(scenario, seed=seed, stride_s=stride_s, stride_m=stride_m, rate_hz=rate_hz, laps=laps)
    assert (np.diff(w.t_ns) > 0).all()
    assert not w.vel[w.still].any()
    np.testing.assert_allclose(np.linalg.norm(w.quat_wxyz, axis=1), 1, atol=1e-12)
    assert (np.abs(np.diff(w.quat_wxyz, axis=0)).max() < 1) or rate_hz < 60
    rests = w.pos[w.still]
    axes = 2 if scenario == "lift" else 3  # a lift carries the foot away from where it fell
    feet = w.simulation.route.footfalls[:, :axes]
    nearest = np.min(np.linalg.norm(rests[:, None, :axes] - feet[None], axis=2), axis=1)
    assert nearest.max() < 1e-9


def test_the_importer_gives_back_what_was_written_and_the_truth(tmp_path: Path) -> None:
    defects = {"boot_chatter": True, "wall_clock": True, "drop_share": 0.02, "duplicate_share": 0.02}
    done = sim.simulate("stairs", tmp_path, seed=9, config="1332", start_ms=2**32 - 9000, **defects)
    convert(done.paths, tmp_path / "w.mcap")
    rec = mr.open(tmp_path / "w.mcap")
    for sensor, reference in ((1, "/reference/pose"), (2, "/reference/imu2/pose")):
        w = sim.walk("stairs", seed=9, config="1332", start_ms=2**32 - 9000, sensor=sensor)  # type: ignore[arg-type]
        imu = rec.table(f"/foot/imu{sensor}")
        at = np.searchsorted(w.t_ns, imu["t_ns"].to_numpy())
        np.testing.assert_array_equal(w.t_ns[at], imu["t_ns"])
        assert (np.diff(at) > 0).all()
        assert 0.96 < len(at) / len(w.t) < 0.995
        read = imu.select("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z").to_numpy()
        np.testing.assert_allclose(read, np.hstack(w.measured())[at], rtol=1e-12, atol=1e-12)
        pose = rec.table(reference)
        np.testing.assert_array_equal(pose["t_ns"], w.t_ns)
        np.testing.assert_allclose(pose.drop("t_ns"), np.hstack((w.pos, w.quat_wxyz)), atol=1e-12)
    assert rec.metadata["truth"]["closed"] == "true"
    assert float(rec.metadata["truth"]["length_m"]) == pytest.approx(done.length_m, abs=1e-6)


def test_packets_and_text_become_the_same_recording(tmp_path: Path) -> None:
    tables = []
    for kind in ("text", "packets"):
        done = sim.simulate("straight", tmp_path / kind, format=kind)
        convert(done.paths, tmp_path / f"{kind}.mcap")
        rec = mr.open(tmp_path / f"{kind}.mcap")
        tables.append([rec.table(f"/foot/imu{k}").select("t_ns", "acc_x", "gyr_z") for k in (1, 2)])
    assert all(a.equals(b) for a, b in zip(*tables, strict=True))
