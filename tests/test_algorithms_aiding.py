"""Aids of the foot filters: what each one cures, where it must keep still, and what it computes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.algorithms import AlgorithmError, make
from marcha.algorithms.foot import core, iez9
from marcha.algorithms.foot.aiding import stance, straight
from marcha.algorithms.numerics import strapdown
from scipy.spatial.transform import Rotation

from . import algorithms_reference as ref
from .algorithms_support import columns, simulated
from .algorithms_support import run as run_any
from .contracts.estimator import RowEstimatorContract

AIDED = ("foot.9iez", "foot.15iez-zaru")
FIELD_N = np.array([22e-6, 5e-6, -40e-6])
ALL: dict[str, Any] = {
    "hupt": True,
    "heading_aid": "ihde",
    "straight_strides": 2,
    "magnetometer": True,
    "barometer": True,
    "aid_every_s": 0.3,
}
DRIFT = 0.002
"""rad/s that the gyroscope's z axis is off after the rest: 10 degrees in the walks below."""


def run(name: str, rows: np.ndarray, **params: Any) -> tuple[dict[str, np.ndarray], Any]:
    """Run with the source's settings: without an aid, what it mends is large enough to be seen."""
    return run_any(name, rows, preset="published", **params)


def with_field(
    rows: np.ndarray, walk: Any, noise: float = 3e-7, first: int = 0, later: np.ndarray = FIELD_N
) -> np.ndarray:
    """Return rows with a magnetometer, every second one from row ``first`` on; ``later`` is the field in n
    after the rest, FIELD_N before.
    """
    there = np.where(np.arange(len(rows))[:, None] < 300, FIELD_N, later)
    field = Rotation.from_quat(walk.quat_wxyz, scalar_first=True).inv().apply(there)
    field = field + noise * np.random.default_rng(5).standard_normal(field.shape)
    field[1::2] = np.nan
    field[:first] = np.nan
    return np.column_stack([rows, field[: len(rows)]])


def with_pressure(rows: np.ndarray, walk: Any, noise: float = 3.0, first: int = 0) -> np.ndarray:
    """Return rows with a barometer (Pa): every fourth one, by the hydrostatic integral of ISO 2533."""
    z = walk.pos[:, 2] - walk.pos[0, 2]
    grid = np.linspace(z.min() - 0.1, z.max() + 0.1, 2001)
    slope = 9.80665 * 0.0289644 / (8.314462618 * (288.15 - 0.0065 * grid))
    falling = np.concatenate(([0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(grid))))
    pressure = 98_000 * np.exp(np.interp(0.0, grid, falling) - np.interp(z, grid, falling))
    pressure = pressure + noise * np.random.default_rng(6).standard_normal(len(z))
    pressure[np.arange(len(z)) % 4 != 0] = np.nan
    pressure[:first] = np.nan
    return np.column_stack([rows, pressure[: len(rows)]])


def drifting(scenario: str, **options: Any) -> tuple[np.ndarray, Any]:
    rows, walk = simulated(scenario, **options)
    rows[300:, 6] += DRIFT
    return rows, walk


def heading_error(result: dict[str, np.ndarray], walk: Any) -> float:
    """Return the heading error at the end in degrees, its value at the start taken off."""
    quat = columns(result, "pose", "quat_w", "quat_x", "quat_y", "quat_z")
    known = np.isfinite(quat[:, 0])
    turn = (
        Rotation.from_quat(quat[known], scalar_first=True)
        * Rotation.from_quat(walk.quat_wxyz[known], scalar_first=True).inv()
    )
    yaw = np.degrees(turn.as_rotvec()[:, 2])
    return float(abs(yaw[-1] - yaw[0]))


def heights(result: dict[str, np.ndarray], walk: Any) -> np.ndarray:
    """Return the error of the height, where it is known."""
    error = result["pose.pos_z"] - (walk.pos - walk.pos[0])[:, 2]
    return error[np.isfinite(error)]


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return all(a[k].tobytes() == b[k].tobytes() for k in a)


# --- the contract
# ---------------------------------------------------------------------------------------------


class AidedContract(RowEstimatorContract):
    params = ALL | {"init_s": 0.5}

    def rows(self) -> np.ndarray:
        rows, walk = simulated("straight", rest_s=0.8)
        return with_pressure(with_field(rows, walk), walk)[:600]


class TestAided9Iez(AidedContract):
    name = "foot.9iez"


class TestAided15IezZaru(AidedContract):
    name = "foot.15iez-zaru"


INTERPRETED = """
import sys
import numpy as np
from marcha.algorithms import make
from tests.test_algorithms_aiding import ALL, AIDED
rows = np.load(sys.argv[1])
out = []
for name in AIDED:
    estimator = make(name, **ALL | {"init_s": 0.5})
    block = np.empty((len(rows), estimator.width))
    estimator.run_block(rows, block)
    out.append(estimator.state)
np.save(sys.argv[2], np.concatenate(out))
"""


def test_interpreted_gives_the_same_state_to_the_bit(tmp_path: Path) -> None:
    rows, walk = simulated("straight", rest_s=0.8)
    rows = with_pressure(with_field(rows, walk), walk)[:520]
    np.save(tmp_path / "rows.npy", rows)
    subprocess.run(
        [sys.executable, "-c", INTERPRETED, str(tmp_path / "rows.npy"), str(tmp_path / "state.npy")],
        check=True,
        cwd=Path(__file__).parents[1],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    wanted = []
    for name in AIDED:
        estimator: Any = make(name, **ALL, init_s=0.5)
        estimator.run_block(rows, np.empty((len(rows), estimator.width)))
        aids = estimator.record.aids
        assert min(a.used for a in (aids.height, aids.straight, aids.magnetometer, aids.barometer)) > 0
        wanted.append(estimator.state)
    assert np.load(tmp_path / "state.npy").tobytes() == np.concatenate(wanted).tobytes()


def test_without_aids_the_filter_is_the_sources_to_the_bit() -> None:
    """The same kernels in the source's order, no aid among them."""
    rows = simulated()[0][:1200]
    got, plain = run("foot.9iez", rows)[0], make("foot.9iez", preset="published")
    (s,), ring = plain._views  # type: ignore[attr-defined]
    out = np.empty(plain.width)  # type: ignore[attr-defined]
    result = []

    def navigate() -> None:
        r = ring[s["released"] & (len(ring) - 1)]
        core.release(s, ring)
        if not core.starts(s, r) and s["started"]:
            strapdown.advance(s, r)
            iez9.predict(s, r)
            if r["still"]:
                iez9.zero_velocity(s, r, 0)
        core.emit(s, r, out)
        core.emit_sigma(s, iez9.POS, iez9.VEL, iez9.ATT, out)
        core.emit_detector(r, core.AFTER_SIGMA, out)
        result.append(out.copy())

    for row in rows:
        if core.take(s, ring, row):
            navigate()
    while core.take_end(s, ring):
        navigate()
    assert np.array(result).tobytes() == np.column_stack(list(got.values())).tobytes()


@pytest.mark.parametrize("name", AIDED)
def test_inputs_are_those_that_the_aids_need(name: str) -> None:
    def schemas(**params: Any) -> list[str]:
        return [i.schema.rpartition("/")[2] for i in make(name, **params).inputs]

    assert schemas() == schemas(hupt=True, heading_aid="hdr") == ["Imu"]
    assert schemas(magnetometer=True) == ["Imu", "MagneticField"]
    assert schemas(barometer=True) == ["Imu", "FluidPressure"]
    assert schemas(magnetometer=True, barometer=True) == ["Imu", "MagneticField", "FluidPressure"]


@pytest.mark.parametrize(
    "params", [{"heading_aid": "compass"}, {"straight_strides": 1}, {"sigma_baro": 0}, {"hupt_max_m": -1}]
)
def test_a_parameter_out_of_range_is_refused(params: dict[str, Any]) -> None:
    with pytest.raises(AlgorithmError, match=next(iter(params))):
        make("foot.9iez", **params)


# --- equal to plain matrices
# ----------------------------------------------------------------------------------


def plain_aided(rows: np.ndarray, still: np.ndarray, first: int, params: Any) -> np.ndarray:
    """Return positions and the diagonal of P: the nine states with every aid, written from the equations."""
    m = ref.Mechanization(rows[: first + 1, 1:7].mean(axis=0))
    p, h_v = np.zeros((9, 9)), np.hstack([np.zeros((3, 6)), np.eye(3)])
    stance, settled, last, level = 0.0, True, np.zeros(3), 0.0
    headings: list[float] = []
    straight: list[float] = []  # corrected directions of the present straight
    grid: float | None = None
    fields: list[np.ndarray] = []
    pressures: list[float] = []
    field0, pressure0, waited = None, None, np.zeros(2)
    exponent = 9.80665 * 0.0289644 / (8.314462618 * 0.0065)
    out = []
    whole = np.zeros(9)  # what the measurements of one sample correct together

    def measure(index: int, seen: float, sigma: float) -> np.ndarray:
        nonlocal p, whole
        considered = 3 if index == 5 else 0  # a height leaves the attitude alone
        k, p = ref.joseph(p, np.eye(9)[[index]], np.array([[sigma**2]]), considered)
        dx = k[:, 0] * (seen - whole[index])
        whole = whole + dx
        return dx

    def angle(x: float) -> float:
        return float(np.angle(np.exp(1j * x)))

    def straight_walking() -> None:
        nonlocal grid, straight, headings
        way = m.p - last
        if np.hypot(*way[:2]) < params.stride_min_m:
            headings, straight = [], []
            return
        psi = float(np.arctan2(way[1], way[0]))
        headings.append(psi)
        newest = [angle(x - psi) for x in headings[-params.straight_strides :]]
        if len(newest) < params.straight_strides:
            return
        spread = max(abs(x - np.mean(newest)) for x in newest)
        straight = straight or [psi + x for x in newest[:-1]]
        away = angle(psi - float(np.mean(straight)))
        limit = np.radians(params.straight_max_deg)
        if spread >= limit or abs(away) >= limit:
            grid = float(np.mean(straight)) if grid is None and len(straight) > len(newest) - 1 else grid
            straight = []
            return
        if grid is not None:
            away = angle(4 * (psi - grid)) / 4
        turned = measure(2, away, params.sigma_heading / (1 - spread / limit))[2]
        straight.append(psi - turned)

    for i, row in enumerate(rows):
        stance = stance + row[0] if still[i] else 0.0
        if i > first:
            m.step(row)
            f = ref.transition9(m.f_n, row[0])
            p = f @ p @ f.T + np.diag([0.01**2] * 3 + [0] * 3 + [0.1**2] * 3) * row[0] ** 2
            waited += row[0]
            if still[i]:
                k, p = ref.joseph(p, h_v, np.eye(3) * 0.01**2)
                dx = k @ m.v
                m.p, m.v, m.c = m.p - dx[3:6], m.v - dx[6:9], ref.turned(m.c, dx[:3])
        if i == first:
            fields = [m.c @ x for x in fields]
            waited += row[0]
        if not still[i]:
            settled = False
            field0 = np.mean(fields, axis=0) if field0 is None and fields else field0
            if pressure0 is None and pressures:
                pressure0 = np.mean(pressures) * (1 - last[2] * 0.0065 / 288.15) ** -exponent
            fields, pressures = [], []
        else:
            if np.isfinite(row[7]):
                fields.append(m.c @ row[7:10] if i >= first else row[7:10])
            if np.isfinite(row[10]):
                pressures.append(row[10])
        if still[i] and i > first:
            if not settled and stance >= params.aid_after_s:
                settled = True
                if np.linalg.norm(m.p - last) >= params.step_min_m:
                    if abs(m.p[2] - last[2]) < params.hupt_max_m:
                        measure(5, m.p[2] - level, params.sigma_hupt)
                    else:
                        level = m.p[2]
                    straight_walking()
            if settled and field0 is not None and fields and waited[0] >= params.aid_every_s:
                x, fields = np.mean(fields, axis=0), []
                waited[0] = 0.0
                measure(
                    2,
                    angle(np.arctan2(x[1], x[0]) - np.arctan2(field0[1], field0[0])),
                    params.sigma_mag_yaw,
                )
            if settled and pressure0 is not None and pressures and waited[1] >= params.aid_every_s:
                ratio, pressures = np.mean(pressures) / pressure0, []
                waited[1] = 0.0
                height = 288.15 / 0.0065 * (1 - ratio ** (1 / exponent))
                level -= measure(5, m.p[2] - height, params.sigma_baro)[5]
            m.c, m.p, m.v = ref.turned(m.c, whole[:3]), m.p - whole[3:6], m.v - whole[6:9]
            whole = np.zeros(9)
            if settled:
                last = m.p.copy()
        if i >= first:
            out.append(np.concatenate([m.p, m.v, np.sqrt(np.diag(p))[[3, 4, 5, 6, 7, 8, 0, 1, 2]]]))
    return np.array(out)


@pytest.mark.parametrize("aids", ["hupt", "heading", "magnetometer", "barometer", "all"])
def test_every_aid_equals_plain_matrices(aids: str) -> None:
    """One aid alone, where the others' noise is endless, and all together; a rectangle of 6 m by 4 m."""
    rows, walk = drifting("rectangle", late_share=0.0)
    rows = with_pressure(with_field(rows, walk), walk)
    noise = {
        "hupt": "sigma_hupt",
        "heading": "sigma_heading",
        "magnetometer": "sigma_mag_yaw",
        "barometer": "sigma_baro",
    }
    deaf = {sigma: 1e9 for aid, sigma in noise.items() if aids not in (aid, "all")}
    result, estimator = run("foot.9iez", rows, **ALL | deaf)
    first = int(estimator.record.rest.index)
    wanted = plain_aided(rows, result["stance.still"] > 0.5, first, estimator.params)
    got = np.hstack([columns(result, o) for o in ("pose", "velocity", "sigma")])[:, [0, 1, 2, *range(7, 19)]]
    np.testing.assert_allclose(got[first:], wanted, rtol=0, atol=1e-8)
    plain = run("foot.9iez", rows[:, :7])[0]
    away = got[:, :3] - np.column_stack([plain[f"pose.pos_{a}"] for a in "xyz"])
    assert np.abs(away[first:, 2 if aids in ("hupt", "barometer") else 0]).max() > 1e-3


@given(
    angle=st.floats(-50.0, 50.0),
)
def test_angles_are_wrapped(angle: float) -> None:
    wrapped = straight.wrap(angle)
    assert abs(wrapped) <= np.pi + 1e-12
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-12


@given(height=st.floats(-300.0, 300.0))
def test_the_barometric_height_is_the_standard_atmospheres(height: float) -> None:
    """ISO 2533 at sea level: p = 101325 Pa (1 − 2.25577e-5 h)^5.25588, its usual printed constants."""
    pressure = 101_325.0 * (1.0 - 2.25577e-5 * height) ** 5.25588
    got = stance.pressure_height(pressure, 101_325.0, 288.15 / 0.0065)
    assert abs(got - height) < 1e-4 * abs(height) + 1e-6


# --- flat ground
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize("scenario", ["rectangle", "straight", "figure-eight"])
def test_flat_ground_keeps_its_height(name: str, scenario: str) -> None:
    """An accelerometer that is off by 0.2 m/s² upwards: without the aid a step climbs by a centimetre."""
    rows, walk = simulated(scenario, laps=3, acc_bias=(0.0, 0.0, 0.2))
    off, on = heights(run(name, rows)[0], walk), heights(run(name, rows, hupt=True)[0], walk)
    assert abs(off[-1]) > 0.2
    assert abs(on[-1]) < 0.05
    assert np.sqrt(np.mean(on**2)) < 0.5 * np.sqrt(np.mean(off**2))


@pytest.mark.parametrize("name", AIDED)
def test_stairs_pass_untouched(name: str) -> None:
    rows, _ = simulated("stairs", direction="up", stair_steps=24)
    off, on = run(name, rows)[0], run(name, rows, hupt=True)
    assert same(off, on[0])
    assert [r.kind for r in on[1].remarks()] == ["aid_unused"]


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize("riser", [0.08, 0.17])
def test_up_and_down_comes_back_to_the_same_height(name: str, riser: float) -> None:
    rows, walk = simulated("stairs", riser_m=riser, acc_bias=(0.0, 0.0, 0.1))
    error = heights(run(name, rows, hupt=True)[0], walk)
    assert abs(error[-1]) < 0.06
    assert np.abs(error).max() < np.abs(heights(run(name, rows)[0], walk)).max() + 0.02


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize("aid", ["hupt", "barometer"])
def test_a_height_leaves_the_heading_alone(name: str, aid: str) -> None:
    """An accelerometer off by 0.2 m/s²: blamed on the tilt, its height turned the heading by 8 degrees."""
    rows, walk = simulated("rectangle", seed=3, laps=8, acc_bias=(0.0, 0.0, -0.2))
    off = run(name, rows)[0]
    on = run(name, with_pressure(rows, walk) if aid == "barometer" else rows, **{aid: True})[0]
    assert abs(heading_error(on, walk) - heading_error(off, walk)) < 1.5


# --- straight walking
# -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize(
    ("scenario", "aid", "share"),
    [
        ("straight", "hdr", 0.6),
        ("straight", "ihde", 0.6),
        ("rectangle", "hdr", 0.9),
        ("rectangle", "ihde", 0.45),
    ],
)
def test_straight_walking_cuts_the_heading_error(name: str, scenario: str, aid: str, share: float) -> None:
    rows, walk = drifting(scenario, length_m=150.0)
    off, _ = run(name, rows)
    on, _ = run(name, rows, heading_aid=aid)
    assert heading_error(off, walk) > 10
    assert heading_error(on, walk) < share * heading_error(off, walk)


@pytest.mark.parametrize("aid", ["hdr", "ihde"])
def test_a_good_gyroscope_is_not_made_worse(aid: str) -> None:
    for seed in range(4):
        rows, walk = simulated("rectangle", seed=seed, length_m=100.0, gyr_bias_sigma=0.0)
        off, on = run("foot.15iez-zaru", rows)[0], run("foot.15iez-zaru", rows, heading_aid=aid)[0]
        assert heading_error(on, walk) < max(1.0, heading_error(off, walk))


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize("aid", ["hdr", "ihde"])
@pytest.mark.parametrize("length", [25.0, 100.0])
def test_circles_are_not_straightened(name: str, aid: str, length: float) -> None:
    rows, _ = drifting("figure-eight", length_m=length, laps=2)
    on, estimator = run(name, rows, heading_aid=aid)
    assert same(run(name, rows)[0], on)
    assert [r.kind for r in estimator.remarks()] == ["aid_unused"]


@pytest.mark.parametrize("aid", ["hdr", "ihde"])
def test_wide_circles_are_hardly_straightened(aid: str) -> None:
    """Circles of 24 m radius turn by 3.3 degrees a stride: seldom within the gate, with little trust."""
    rows, walk = simulated("figure-eight", length_m=300.0)
    off, on = run("foot.15iez-zaru", rows)[0], run("foot.15iez-zaru", rows, heading_aid=aid)[0]
    assert heading_error(on, walk) < heading_error(off, walk) + 0.5


def test_eight_directions_know_the_diagonal() -> None:
    """A rectangle walked at 45 degrees to the grid that is given."""
    rows, walk = drifting("rectangle", length_m=150.0)
    ways = {"heading_aid": "ihde", "heading_grid": "given", "heading_grid_deg": 45.0}
    eight = run("foot.15iez-zaru", rows, **ways, heading_directions=8)[0]
    four, _ = run("foot.15iez-zaru", rows, **ways, heading_gate_deg=5.0)
    assert heading_error(eight, walk) < 0.45 * heading_error(run("foot.15iez-zaru", rows)[0], walk)
    assert heading_error(four, walk) > heading_error(eight, walk)


# --- magnetometer
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize("scenario", ["rectangle", "figure-eight"])
def test_the_magnetometer_corrects_the_heading(name: str, scenario: str) -> None:
    rows, walk = drifting(scenario, laps=4)
    off = heading_error(run(name, rows)[0], walk)
    on, estimator = run(name, with_field(rows, walk), magnetometer=True)
    assert off > 8
    assert heading_error(on, walk) < 0.6 * off
    assert estimator.remarks() == []


def test_without_field_in_the_rest_the_first_stance_with_one_counts() -> None:
    rows, walk = drifting("rectangle", laps=4)
    on, estimator = run("foot.15iez-zaru", with_field(rows, walk, first=500), magnetometer=True)
    assert estimator.record.aids.magnetometer.used > 40
    assert heading_error(on, walk) < 0.6 * heading_error(run("foot.15iez-zaru", rows)[0], walk)


@pytest.mark.parametrize("gate", ["norm", "dip"])
def test_a_disturbed_field_is_refused(gate: str) -> None:
    rows, walk = drifting("rectangle")
    lower = np.linalg.norm(FIELD_N) * np.array([np.cos(0.9), 0.0, -np.sin(0.9)])  # dip 52, not 61 degrees
    field = with_field(rows, walk, later=1.15 * FIELD_N if gate == "norm" else lower)
    off = run("foot.9iez", rows)[0]
    on, estimator = run("foot.9iez", field, magnetometer=True)
    assert same(off, on)
    assert estimator.record.aids.magnetometer.refused > 10
    assert [r.kind for r in estimator.remarks()] == ["aid_unused"]
    assert "refused" in estimator.remarks()[0].detail


# --- barometer
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AIDED)
@pytest.mark.parametrize("first", [0, 500])
def test_the_barometer_corrects_the_height(name: str, first: int) -> None:
    rows, walk = simulated("rectangle", laps=8, acc_bias=(0.0, 0.0, 0.2))
    off = heights(run(name, rows)[0], walk)
    on, estimator = run(name, with_pressure(rows, walk, first=first), barometer=True)
    assert off[-1] > 0.6
    assert abs(heights(on, walk)[-1]) < 0.72 * off[-1]
    assert estimator.record.aids.barometer.used > 50


def test_the_barometer_follows_stairs_beside_the_flat_ground() -> None:
    rows, walk = simulated("stairs", laps=2, acc_bias=(0.0, 0.0, 0.2))
    both, _ = run("foot.9iez", with_pressure(rows, walk), barometer=True, hupt=True)
    assert np.ptp(both["pose.pos_z"][300:]) > 1.8
    assert np.abs(heights(both, walk)).max() < 0.2


def test_two_sensors_find_their_own_columns() -> None:
    rows, walk = drifting("rectangle", laps=2)
    both = with_pressure(with_field(rows, walk), walk)
    deaf_baro = run("foot.9iez", both, magnetometer=True, barometer=True, sigma_baro=1e9)[0]
    alone = run("foot.9iez", both[:, :10], magnetometer=True)[0]
    np.testing.assert_allclose(deaf_baro["pose.pos_x"], alone["pose.pos_x"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("aid", ["magnetometer", "barometer"])
def test_an_aid_without_its_sensor_is_stated(aid: str) -> None:
    rows, _ = simulated()
    on, estimator = run("foot.9iez", rows, **{aid: True})
    assert same(run("foot.9iez", rows)[0], on)
    assert [r.kind for r in estimator.remarks()] == ["aid_unused"]
    assert "no reading" in estimator.remarks()[0].detail


# --- real
# -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def converted(data_dir: Path, tmp_path_factory: pytest.TempPathFactory):
    """Return a function that opens a real recording, converted."""
    from marcha import ingest, recording

    folder = tmp_path_factory.mktemp("aided")

    def open_(path: str) -> Any:
        (source,) = (data_dir / "foot").glob(path)
        out = folder / f"{source.stem}.mcap"
        if not out.exists():
            ingest.convert([source], out)
        return recording.open(out)

    return open_


def replayed(rec: Any, *estimators: str) -> list[Any]:
    from marcha.replay import replay

    return replay(rec, list(estimators)).runs


@pytest.mark.data
@pytest.mark.parametrize("name", AIDED)
def test_spiral_stairs_survive_flat_ground(converted: Any, name: str) -> None:
    (run_,) = replayed(converted("stairs/*.csv"), f"{name}[hupt=true]")
    assert abs(run_.metrics["height_end_m"] - 5.4) < 0.5


@pytest.mark.data
def test_the_real_rectangle_is_flat(converted: Any) -> None:
    for code in ("1111", "2222", "2323", "3333"):
        off, on = replayed(converted(f"mpu6050/conf-{code}-*.csv"), "foot.9iez", "foot.9iez[hupt=true]")[::2]
        assert off.input == on.input == "/foot/imu1"
        assert off.metrics["height_end_m"] > 0.25
        assert abs(on.metrics["height_end_m"]) < 0.6 * off.metrics["height_end_m"]


@pytest.mark.data
def test_a_field_between_steel_stairs_is_refused(converted: Any) -> None:
    off, on = replayed(converted("stairs/*.csv"), "foot.9iez", "foot.9iez[magnetometer=true]")
    assert off.metrics["closure_m"] == on.metrics["closure_m"]
    assert "aid_unused" in [f.kind for f in on.findings]
    assert "/foot/mag" in str(on.lineage)
