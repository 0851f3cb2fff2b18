"""What ``indoor.fused`` learns on the way, how sure its radio map is, and where it gives no position."""

from __future__ import annotations

import re

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import AlgorithmError, Calibration, Stretch, make
from marcha.algorithms.indoor.anchors import anchors_of
from marcha.algorithms.indoor.calibrate import RadioCalibration
from marcha.algorithms.indoor.radio_map import map_of
from marcha.ingest.simulate.floor import shadowing

from .event_loop import context_of, drive
from .test_indoor_estimators import ETA, FLOOR, MACS, errors, heard, table, walk


def survey(count: int, keep=range(6), seed=0, device="a", shadow_db=3.0) -> Stretch:
    """A survey at random places, with shadowing that belongs to the place."""
    rng = np.random.default_rng(seed)
    powers, where = [], []
    for k in range(count):
        place = rng.uniform([0, 0], [24, 8])
        part = heard(np.tile(place, (60, 1)), 1.0, keep, seed=k)
        fields = {
            m: shadow_db * shadowing(place[None], 4.0, np.random.default_rng([9, i]))[0]
            for i, m in enumerate(MACS)
        }
        extra = pl.Series([fields[m] for m in part["mac"]])
        part = part.with_columns(
            t_ns=pl.col("t_ns") + k * 60_000_000_000, rssi_dbm=pl.col("rssi_dbm") + extra
        )
        powers.append(part)
        where += [(part["t_ns"][0], *place, 1.2), (part["t_ns"][-1], *place, 1.2)]
    position = pl.DataFrame(where, schema=["t_ns", "pos_x", "pos_y", "pos_z"], orient="row")
    about = {"device": {"name": device}}
    return Stretch(
        {}, {"radio": (pl.concat(powers),), "position": (position,)}, about, table(model=False), "survey"
    )


def run(estimator, radio: pl.DataFrame, **kwargs):
    return drive(
        estimator,
        {"radio": {"/r": radio}},
        attachments=kwargs.pop("attachments", table(model=False)),
        **kwargs,
    )


def remark(estimator, kind: str) -> str:
    return next(r.detail for r in estimator.remarks() if r.kind == kind)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return RadioCalibration().calibrate([survey(24, keep=range(5))])


def test_the_exponent_of_an_anchor_without_calibration_is_learned(calibration: Calibration) -> None:
    """The sixth anchor has pooled values; a walk by it says what its own are better than the pool does."""
    path = np.column_stack([np.linspace(6, 22, 900), np.full(900, 2.5)])
    estimator = make("indoor.fused", seed=2)
    run(estimator, heard(path, 2.0, seed=4), calibrations={"radio": calibration})
    said = re.search(r"(-[\d.]+) dBm, η ([\d.]+) ± ([\d.]+)", remark(estimator, "learned_anchors"))
    assert said is not None
    power, eta, sd = map(float, said.groups())
    pooled = calibration.values["pooled"]["ble"]
    at = np.array([2.0, 5.0, 12.0])  # what counts is the power over the distances that were walked
    true = -57.55 - 10 * ETA[5] * np.log10(at)
    before = pooled["p_d0"] - 10 * pooled["eta"] * np.log10(at)
    after = power - 10 * eta * np.log10(at)
    assert np.abs(after - true).mean() < max(np.abs(before - true).mean(), 1.5)
    assert abs(eta - ETA[5]) < 2.5 * sd
    assert sd < np.sqrt(pooled["between"][1][1])


@pytest.mark.parametrize("device", ["a", "another"])
def test_the_offset_of_a_receiver_is_learned(calibration: Calibration, device: str) -> None:
    """Of one that was not calibrated, and of one that was and has changed."""
    path = walk(900)
    about = {"calibrations": {"radio": calibration}, "metadata": {"device": {"name": device}}}
    wrong = {}
    for offset in (0.0, -8.0):
        radio = heard(path, 3.0, seed=5).with_columns(pl.col("rssi_dbm") + offset)
        estimator = make("indoor.fused", seed=2)
        wrong[offset] = errors(run(estimator, radio, **about)["position"], path)[200:].mean()
        learned = [float(r.detail.split()[3]) for r in estimator.remarks() if r.kind == "learned_offset"]
        assert learned or (device == "a" and offset == 0)
        assert learned == pytest.approx([offset] * len(learned), abs=3.0)
    assert wrong[-8.0] < wrong[0.0] + 0.5


def test_a_radio_map_is_as_sure_as_it_is_right(calibration: Calibration) -> None:
    """Powers at places that the survey did not have lie within two sigmas as often as they should."""
    context = context_of(
        make("indoor.fused"), {}, attachments=table(model=False), calibrations={"radio": calibration}
    )
    anchors = anchors_of(context)
    found = map_of(context, anchors, 1.2)
    assert found is not None
    assert found.mapped.tolist() == [True] * 5 + [
        False
    ]  # one anchor without survey leaves the others their map
    rng = np.random.default_rng(3)
    places = rng.uniform([1, 1], [23, 7], size=(200, 2))
    i, j = np.round((places - found.low) / found.cell).astype(int).T
    inside = []
    for k in range(5):
        d = np.maximum(np.linalg.norm(places - FLOOR[k], axis=1), 0.3)
        power = (
            -57.55 - 10 * ETA[k] * np.log10(d) + 3.0 * shadowing(places, 4.0, np.random.default_rng([9, k]))
        )
        inside.append(np.abs(power - found.mean[0, k, i, j]) < 2 * found.sd[0, k, i, j])
    assert 0.85 < np.mean(inside) < 0.995


def test_an_anchor_whose_powers_do_not_fall_has_pooled_values(calibration: Calibration) -> None:
    import copy
    import dataclasses

    values = copy.deepcopy(calibration.values)
    values["anchors"][0]["eta"] = -0.5
    bad = dataclasses.replace(calibration, values=values) if dataclasses.is_dataclass(calibration) else None
    if bad is None:
        import msgspec

        bad = msgspec.structs.replace(calibration, values=values)
    estimator = make("indoor.trilateration")
    run(estimator, heard(walk(100), 1.0), calibrations={"radio": bad})
    assert "η below 0.3 of a1" in remark(estimator, "flat_anchors")


@pytest.mark.parametrize(
    ("keep", "places", "kind"),
    [
        ((0,), FLOOR, "too_few_anchors"),
        (range(4), np.column_stack([FLOOR[:, 0], np.full(6, 3.0)]), "collinear_anchors"),
    ],
)
def test_anchors_that_leave_a_mirror_image_give_no_position(keep, places, kind) -> None:
    rows = "".join(f"{MACS[i]},ble,{x},{y},1.2,-57,2,\n" for i, (x, y) in enumerate(places))
    attachments = {"anchors.csv": f"mac,technology,x,y,z,p_d0,eta,name\n{rows}".encode()}
    estimator = make("indoor.fused")
    run(estimator, heard(walk(60), 2.0, keep), attachments=attachments)
    assert any(r.kind == kind and r.fatal for r in estimator.remarks())


def test_powers_of_unknown_transmitters_alone_give_no_position() -> None:
    radio = heard(walk(60), 2.0).with_columns(mac=pl.lit("12:00:00:00:00:99"))
    estimator = make("indoor.fused")
    run(estimator, radio, attachments=table())
    assert {"nothing_heard", "unknown_anchor"} <= {
        r.kind for r in estimator.remarks() if r.fatal or r.kind != "nothing_heard"
    }


def test_a_turning_carrier_is_recognised_and_does_not_turn_the_track() -> None:
    """5 dB stronger ahead than behind, a turn in 12 s: there is less error, the ellipse holds, and it is said."""
    path = walk(900)
    radio = heard(path, 3.0, seed=7)
    where = FLOOR[[MACS.index(m) for m in radio["mac"]]] - path
    turn = 5.0 * np.cos(2 * np.pi * radio["t_ns"].to_numpy() / 12e9 - np.arctan2(where[:, 1], where[:, 0]))
    turned = radio.with_columns(pl.col("rssi_dbm") + pl.Series(turn))
    mean, inside, said = {}, {}, {}
    for name, powers, turning in (("never", turned, 0.0), ("turned", turned, 0.3), ("still", radio, 0.3)):
        estimator = make("indoor.fused", seed=3, turning=turning)
        positions = run(estimator, powers, attachments=table())
        wrong = errors(positions["position"], path)[100:]
        sd = positions["sigma"].select("sigma_pos_x", "sigma_pos_y").to_numpy()[100:]
        mean[name] = wrong.mean()
        inside[name] = (wrong**2 < 5.991 * (sd**2).max(axis=1)).mean()
        said[name] = "turning_carrier" in {r.kind for r in estimator.remarks()}
    assert mean["turned"] < 0.8 * mean["never"]
    assert inside["turned"] > 0.85
    assert said == {"never": False, "turned": True, "still": False}


def test_particles_are_handed_out_without_a_change_of_the_track() -> None:
    path = walk(200)
    found = run(make("indoor.fused", particles=100), heard(path, 4.0), attachments=table())
    times, counts = np.unique(found["particles"]["t_ns"].to_numpy(), return_counts=True)
    assert len(times) == pytest.approx(20, abs=1)
    assert set(counts.tolist()) == {60}
    for t in times.tolist():
        here = found["particles"].filter(pl.col("t_ns") == t).select("particle_x", "particle_y").to_numpy()
        at = found["position"].filter(pl.col("t_ns") == t).select("pos_x", "pos_y").to_numpy()[0]
        sd = found["sigma"].filter(pl.col("t_ns") == t).select("sigma_pos_x", "sigma_pos_y").to_numpy()[0]
        assert (np.abs(here.mean(axis=0) - at) < 0.5 * sd + 0.05).all()


def test_triples_are_what_a_fix_is_the_mean_of() -> None:
    found = run(
        make("indoor.trilateration", reach_m=0),
        heard(np.tile([10.0, 4.0], (200, 1)), 1.0),
        attachments=table(),
    )
    mean = found["triples"].group_by("t_ns", maintain_order=True).mean()
    np.testing.assert_allclose(
        mean.select("triple_x", "triple_y").to_numpy(), found["position"].select("pos_x", "pos_y").to_numpy()
    )


def test_without_positions_it_still_refuses() -> None:
    with pytest.raises(AlgorithmError, match="anchor positions"):
        run(make("indoor.fused"), heard(walk(20), 1.0), attachments={})
