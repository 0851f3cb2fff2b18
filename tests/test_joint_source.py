"""The source's filters: matrices, jump rules and gains against dense matrices in NumPy and printed figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import make
from numpy.testing import assert_allclose

from .event_loop import context_of, drive, messages_of

T = 0.02
G = 9.81
R_ACC = {"trunk": 0.0014, "thigh": 0.0014, "shank": 0.0017, "foot": 0.0017}
COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


def table(acc: np.ndarray, gyr: np.ndarray, t_ns: np.ndarray | None = None) -> pl.DataFrame:
    times = np.arange(len(acc)) * 20_000_000 if t_ns is None else t_ns
    return pl.DataFrame({"t_ns": times, **dict(zip(COLUMNS, np.hstack([acc, gyr]).T, strict=True))})


def motion(n: int, seed: int, size: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Gravity turned at random with noise, and rates that do not fit it (the algebra does not mind)."""
    rng = np.random.default_rng(seed)
    roll, pitch = 0.8 * np.sin(np.arange(n) * 0.05 * (1 + seed)), 0.2 * np.cos(np.arange(n) * 0.07)
    f = np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], 1)
    return G * f + size * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))


def inputs(names: tuple[str, ...], n: int, encoder: np.ndarray | None = None) -> dict[str, Any]:
    found: dict[str, Any] = {s: {f"/leg/{s}/imu": table(*motion(n, i))} for i, s in enumerate(names)}
    if encoder is not None:
        joints = {j: encoder[:, k] for k, j in enumerate(joint_names(names))}
        found["encoder"] = {"/leg/encoder": pl.DataFrame({"t_ns": np.arange(n) * 20_000_000, **joints})}
    return found


def joint_names(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple({"trunk": "hip", "thigh": "knee", "shank": "ankle"}[s] for s in names[:-1])


def angles(acc: np.ndarray, axes: int) -> np.ndarray:
    x, y, z = acc.T
    all3 = [np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z)), np.arctan2(np.hypot(x, y), z)]
    return np.stack(all3[:axes], 1)


def dense(
    kind: str, names: tuple[str, ...], data: dict[str, Any], axes: int, zeta: float, joint: float, policy: str
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """The spec's table of matrices, written out: angles, gains by row and jump states of every step."""
    n, block = len(names), 2 * axes
    tables = [next(iter(data[s].values())) for s in names]
    acc = [t.select(COLUMNS[:3]).to_numpy() for t in tables]
    gyr = [t.select(COLUMNS[3:]).to_numpy()[:, :axes] for t in tables]
    encoder = None
    if "encoder" in data:
        encoder = next(iter(data["encoder"].values())).select(joint_names(names)).to_numpy()
    theta_a = [angles(a, axes) for a in acc]
    theta_g = [
        t[0] + np.vstack([np.zeros(axes), np.cumsum(0.5 * T * (g[1:] + g[:-1]), axis=0)])
        for t, g in zip(theta_a, gyr, strict=True)
    ]
    rho = np.abs(np.stack([np.linalg.norm(a, axis=1) for a in acc], 1) - G)
    small = np.array([[0.0, 1.0], [0.0, -1e-15]])
    f = np.eye(n * block) + T * np.kron(np.eye(n * axes), small)
    q = T * T * 1e-7 * np.eye(n * block)
    s1 = np.kron(np.eye(axes), [[1.0, 0.0]])
    own = [np.hstack([s1 if k == i else np.zeros_like(s1) for k in range(n)]) for i in range(n)]
    r = np.eye(1, block)
    joints = [
        np.hstack([r if k == j else -r if k == j + 1 else np.zeros_like(r) for k in range(n)])
        for j in range(n - 1)
    ]
    x, p = np.zeros(n * block), np.eye(n * block)
    rows_all = n * axes + n - 1
    held = np.zeros(rows_all)
    out, gains, jumps = [], [], []
    out.append(np.hstack([t[0] for t in theta_g]))
    for k in range(1, len(acc[0])):
        x, p = f @ x, f @ p @ f.T + q
        usable = rho[k] <= zeta
        best = int(np.argmin(rho[k]))
        jump = n if kind in ("local", "global") or (kind == "smea" and usable.all()) else best
        h, z, v, index = [], [], [], []
        for i in range(n):
            if jump not in (n, i):
                continue
            fresh = theta_a[i][k] - theta_g[i][k]
            for a in range(axes):
                m = i * axes + a
                value = fresh[a] - 2 * np.pi * np.round((fresh[a] - x[2 * m]) / (2 * np.pi))
                if not usable[i]:
                    if policy == "drop":
                        continue
                    value = 0.0 if policy == "zero" else held[m]
                held[m] = value
                h.append(own[i][a])
                z.append(value)
                v.append(R_ACC[names[i]])
                index.append(m)
        for j in range(n - 1):
            if kind == "local":
                break
            m = n * axes + j
            turned = theta_g[j][k, 0] - theta_g[j + 1][k, 0]
            if kind == "global":
                value = theta_a[j][k, 0] - theta_a[j + 1][k, 0] - turned
                expected = float(joints[j][0] @ x)
                value -= 2 * np.pi * np.round((value - expected) / (2 * np.pi))
                if not (usable[j] and usable[j + 1]):
                    if policy == "drop":
                        continue
                    value = 0.0 if policy == "zero" else held[m]
                held[m] = value
            else:
                assert encoder is not None
                value = encoder[k, j] - turned
            h.append(joints[j][0])
            z.append(value)
            v.append(joint)
            index.append(m)
        gain_all = np.zeros((n * block, rows_all))
        if h:
            hm, rm = np.array(h), np.diag(v)
            gain = p @ hm.T @ np.linalg.inv(hm @ p @ hm.T + rm)
            x = x + gain @ (np.array(z) - hm @ x)
            left = np.eye(n * block) - gain @ hm
            p = left @ p @ left.T + gain @ rm @ gain.T
            gain_all[:, index] = gain
        gains.append(gain_all)
        jumps.append(jump)
        out.append(np.hstack([t[k] for t in theta_g]) + x[::2])
    return np.array(out), gains, np.array(jumps)


FOUR = ("trunk", "thigh", "shank", "foot")
CASES = [
    ("joint.local", "local", FOUR, 1),
    ("joint.global", "global", FOUR, 1),
    ("joint.smp", "smp", FOUR, 1),
    ("joint.sme", "sme", FOUR[:3], 3),
    ("joint.sme", "sme", FOUR[1:3], 3),
    ("joint.sme", "sme", FOUR, 3),
]


@pytest.mark.parametrize("policy", ["drop", "zero", "hold"])
@pytest.mark.parametrize(("name", "kind", "names", "axes"), CASES)
def test_filter_equals_dense_matrices(
    name: str, kind: str, names: tuple[str, ...], axes: int, policy: str
) -> None:
    n = 60
    has_encoder = kind in ("smp", "sme")
    encoder = 0.3 * np.random.default_rng(5).normal(size=(n, len(names) - 1)) if has_encoder else None
    data = inputs(names, n, encoder)
    params: dict[str, Any] = {"zeta": 0.4, "unusable": policy}
    if axes == 3:
        params["yaw"] = "acc-tilt"
    joint = 0.5
    if kind != "local":
        joint = 0.01
        params["sigma2_joint"] = joint
    estimator: Any = make(name, **params)
    found = drive(estimator, data)
    angle, gains, jumps = dense(kind, names, data, axes, 0.4, joint, policy)
    assert_allclose(found["attitude"].drop("t_ns", "t_log_ns").to_numpy(), angle, rtol=1e-6, atol=1e-8)
    assert_allclose(found["jump"]["state"].to_numpy()[1:], jumps)
    rows = gains[-1].shape[1]
    assert_allclose(estimator.state["K"][0][: gains[-1].shape[0], :rows], gains[-1], rtol=1e-6, atol=1e-9)
    flexion = angle.reshape(n, len(names), axes)[:, :, 0]
    if len(names) > 1:
        assert_allclose(
            found["joint"].drop("t_ns", "t_log_ns").to_numpy(), flexion[:, :-1] - flexion[:, 1:], atol=1e-8
        )


def still(names: tuple[str, ...], quiet: str, n: int = 2, encoder: bool = True) -> dict[str, Any]:
    """Segments at rest; only ``quiet`` has the norm g exactly."""
    found: dict[str, Any] = {}
    for s in names:
        acc = np.tile([0.0, 0.0, G if s == quiet or quiet == "all" else G + 0.3], (n, 1))
        found[s] = {f"/leg/{s}/imu": table(acc, np.zeros((n, 3)))}
    if encoder:
        found["encoder"] = {
            "/leg/encoder": pl.DataFrame(
                {"t_ns": np.arange(n) * 20_000_000, **{j: np.zeros(n) for j in joint_names(names)}}
            )
        }
    return found


def first_gains(name: str, names: tuple[str, ...], quiet: str, n: int = 2, **params: Any) -> np.ndarray:
    estimator: Any = make(name, **params)
    drive(estimator, still(names, quiet, n, name != "joint.smea"))
    return estimator.state["K"][0]


@pytest.mark.parametrize(
    ("quiet", "segment", "rows", "printed"),
    [
        ("thigh", 0, (0, 6), (0.997673, 0.000931)),
        ("thigh", 1, (0, 6), (0.665204, -0.666135)),
        ("shank", 0, (3, 6), (0.664872, 0.666002)),
        ("shank", 1, (3, 6), (0.997176, -0.001130)),
    ],
)
def test_sme_two_segments_first_gains(quiet: str, segment: int, rows: Any, printed: Any) -> None:
    gain = first_gains("joint.sme", ("thigh", "shank"), quiet, yaw="acc-tilt")
    assert_allclose(gain[6 * segment, list(rows)], printed, atol=1e-6)
    assert_allclose(
        gain[2, 1] if quiet == "thigh" else gain[8, 4], 0.998603 if quiet == "thigh" else 0.998304, atol=1e-5
    )


def test_smea_first_gains() -> None:
    estimator: Any = make("joint.smea", yaw="acc-tilt", identify="off")
    estimator.start(context_of(estimator, still(("thigh", "shank"), "all", 4, False)))
    for message in messages_of(estimator, still(("thigh", "shank"), "all", 4, False)):
        list(estimator.take(message) or ())
    gain = estimator.state["K"][0]
    assert_allclose(gain[0, :7], [0.995828, 0, 0, 0.002774, 0, 0, 0.002779], atol=1e-6)
    assert_allclose(gain[6, :7], [0.003369, 0, 0, 0.994936, 0, 0, -0.003373], atol=1e-6)


def test_sme_three_segments_and_smp_first_gains() -> None:
    gain = first_gains("joint.sme", FOUR[:3], "thigh", yaw="acc-tilt")
    assert_allclose(gain[0, [3, 9, 10]], [0.664585, 0.666135, 0.000620], atol=1e-6)
    assert_allclose(gain[6, [3, 9, 10]], [0.996745, -0.000930, 0.000930], atol=1e-6)
    assert_allclose(gain[12, [3, 9, 10]], [0.664585, -0.000620, -0.666135], atol=1e-6)
    gain = first_gains("joint.smp", FOUR, "shank")
    assert_allclose(gain[0, [2, 4, 5, 6]], [0.362157, 0.545317, 0.363183, 0.000410], atol=1e-6)
    assert_allclose(gain[2, [2, 4, 5, 6]], [0.543163, -0.182134, 0.544701, 0.000615], atol=1e-6)
    assert_allclose(gain[4, [2, 4, 5, 6]], [0.995642, -0.000615, -0.001538, 0.001128], atol=1e-6)
    assert_allclose(gain[6, [2, 4, 5, 6]], [0.663850, -0.000410, -0.001026, -0.666003], atol=1e-6)


@pytest.mark.parametrize(
    ("steps", "printed"),
    [(1, (0.99860252, 0.01996406)), (2, (0.56236349, 6.25819086)), (60, (0.0650166, 0.0819476))],
)
def test_fkc_gains_with_g_equal_to_t(steps: int, printed: tuple[float, float]) -> None:
    estimator: Any = make("joint.fkc")
    drive(estimator, {"imu": still(("thigh",), "all", steps + 1, False)["thigh"]})
    assert_allclose(estimator.state["K"][0][:2, 0], printed, rtol=2e-6)


def test_printed_sign_of_the_joint_row_is_wrong() -> None:
    """[−r r] is what an encoder of the other sign would give: with a trusted encoder it ruins the filter."""
    n = 300
    knee = 0.5 * np.sin(np.arange(n) * T * 2)
    data: dict[str, Any] = {}
    for s, roll in (("thigh", knee), ("shank", 0 * knee)):
        acc = G * np.stack([0 * roll, np.sin(roll), np.cos(roll)], 1)
        # The shank's accelerometer is never the quiet one: only the joint row holds it.
        acc *= 1.0 if s == "thigh" else 1.1
        gyr = np.stack([np.gradient(roll, T), 0 * roll, 0 * roll], 1)
        gyr[:, 0] += 0.05 if s == "shank" else 0.0
        data[s] = {f"/{s}": table(acc, gyr)}

    def error(sign: float) -> float:
        data["encoder"] = {"/e": pl.DataFrame({"t_ns": np.arange(n) * 20_000_000, "knee": sign * knee})}
        found = drive(make("joint.sme", sigma2_joint=0.0005), data)["attitude"]
        return float(np.degrees(np.sqrt(np.mean(found["shank_roll"].to_numpy()[60:] ** 2))))

    assert error(1.0) < 1.5
    assert error(-1.0) > 15.0


def test_pitch_has_no_cross_gain() -> None:
    """H, F, Q and P couple segments on the flexion axis only; the published shares cannot follow from table 5."""
    data = inputs(FOUR[1:3], 80, np.zeros((80, 1)))
    cross = drive(make("joint.sme", zeta=10.0), data)["cross"]
    shares = cross.tail(40)
    own = shares["thigh_pitch"].to_numpy()
    assert np.all((own == 0.0) | np.isnan(own) | (own == 1.0) | (own < 1e-12))
    assert np.nanmin(shares["thigh_roll"].to_numpy()) == pytest.approx(0.0014 / 0.5, rel=0.3)


def test_blocks_of_any_size_give_the_bits_of_single_messages() -> None:
    data = inputs(FOUR[1:3], 200)
    one: Any = make("joint.smea")
    context = context_of(one, data)
    one.start(context)
    messages = messages_of(one, data)
    single = [(r.output, r.t_ns, *r.values) for m in messages for r in one.take(m) or ()]
    single += [(r.output, r.t_ns, *r.values) for r in one.finish()]
    for size in (7, 64, len(messages)):
        block: Any = make("joint.smea")
        block.start(context)
        got = []
        for first in range(0, len(messages), size):
            part = messages[first : first + size]
            k = len(part)
            out = np.zeros(2 * k, np.int64), np.zeros(2 * k, np.int64), np.full((2 * k, block.width), np.nan)
            which = np.array([[i.name for i in block.inputs].index(m.input) for m in part])
            count = block.run(
                block.state,
                which,
                np.zeros(k, np.int64),
                np.array([m.t_ns for m in part]),
                np.array([m.values for m in part]),
                *out,
            )
            got += [(r.output, r.t_ns, *r.values) for r in block.results(out[1][:count], out[2][:count])]
        got += [(r.output, r.t_ns, *r.values) for r in block.finish()]
        assert str(got) == str(single)


def test_sensors_of_other_rates_and_a_missing_stretch() -> None:
    """A shank sensor at another rate and phase gives the same angle; where it is missing, angles are left out."""

    def leg(rate: float, shift: float, amplitude: float) -> pl.DataFrame:
        t = np.arange(0.0, 12.0, 1 / rate) + shift
        roll, rate_x = amplitude * np.sin(3 * t), amplitude * 3 * np.cos(3 * t)
        acc = G * np.stack([0 * t, np.sin(roll), np.cos(roll)], 1)
        return table(acc, np.stack([rate_x, 0 * t, 0 * t], 1), np.round(t * 1e9).astype(np.int64))

    shank = leg(170.0, 0.0031, 0.3)
    hole = (shank["t_ns"] < 4_000_000_000) | (shank["t_ns"] > 6_000_000_000)
    data = {"thigh": {"/t": leg(50.0, 0.0, 0.7)}, "shank": {"/s": shank.filter(hole)}}
    estimator = make("joint.local")
    found = drive(estimator, data)["joint"]
    t = found["t_ns"].to_numpy() * 1e-9
    knee = found["knee"].to_numpy()
    inside = (t > 4.01) & (t < 5.99)
    assert np.isnan(knee[inside]).all()
    good = ~((t > 3.99) & (t < 6.01)) & (t < 11.9) & np.isfinite(knee)
    assert good.sum() > 450
    assert np.degrees(np.abs(knee[good] - 0.4 * np.sin(3 * t[good]))).max() < 0.2
    assert any(r.kind == "sensor_missing" and "shank" in r.detail for r in estimator.remarks())


def test_encoder_jump_by_a_turn_is_taken_out_and_said() -> None:
    data = inputs(FOUR[1:3], 60, np.zeros((60, 1)))
    plain = drive(make("joint.sme"), data)["joint"]["knee"].to_numpy()
    topic = "/leg/encoder"
    data["encoder"] = {
        topic: data["encoder"][topic].with_columns(knee=np.where(np.arange(60) > 30, 2 * np.pi, 0.0))
    }
    estimator = make("joint.sme")
    assert_allclose(drive(estimator, data)["joint"]["knee"].to_numpy(), plain, atol=1e-9)
    assert [r.kind for r in estimator.remarks()].count("encoder_turns") == 1
