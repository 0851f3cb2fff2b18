"""Floors in the particle filter: a simulated walk over two floors, by anchors heard, barometer and stairs."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import AlgorithmError, make
from marcha.algorithms.indoor.floors import SCALE_M
from marcha.algorithms.indoor.storeys import storeys_of
from marcha.ingest.simulate.floor import shadowing

from .event_loop import drive

ANCHORS = [(2, 1, 0), (12, 7, 0), (22, 1, 0), (2, 7, 1), (12, 1, 1), (22, 7, 1)]
"""x, y (m) and floor, 2.6 m above each."""
MACS = [f"a0:e6:f8:00:01:0{k}" for k in range(6)]
STOREY_M, SLAB_DB = 3.4, 13.0
UP_S, STAIRS_S = 36.0, 12.0
"""When the stairs are reached, and how long they take."""
STAIRS = {"type": "Polygon", "coordinates": [[[19.5, 3], [22, 3], [22, 5], [19.5, 5], [19.5, 3]]]}


def walked(t: np.ndarray) -> np.ndarray:
    """Place at times (s): along floor 0, up the stairs at x = 21, back along floor 1; x, y, z (m), shape (n, 3)."""
    corners = np.array([0.0, UP_S, UP_S + STAIRS_S, 2 * UP_S + STAIRS_S])
    x = np.interp(t, corners, [3.0, 21.0, 21.0, 3.0])
    return np.column_stack([x, np.full(len(t), 4.0), np.interp(t, corners, [0, 0, STOREY_M, STOREY_M])])


def two_floors(seed: int = 1) -> dict[str, dict[str, pl.DataFrame]]:
    """Ten powers a second with 3 dB of fading and of shadowing, and pressure at 5 Hz with 2 Pa of noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 2 * UP_S + STAIRS_S, 0.1)
    where, who = walked(t), rng.integers(0, 6, len(t))
    place = np.array(ANCHORS, dtype=float)
    dz = where[:, 2] + 1.2 - (STOREY_M * place[who, 2] + 2.6)
    d = np.sqrt(((where[:, :2] - place[who, :2]) ** 2).sum(axis=1) + dz**2)
    floor = where[:, 2] > STOREY_M / 2
    rssi = -58.0 - 18 * np.log10(np.maximum(d, 0.5)) - SLAB_DB * (floor != place[who, 2])
    for k in range(6):
        for f in (0, 1):  # shadowing of one floor says nothing of the other
            here = (who == k) & (floor == f)
            rssi[here] += 3.0 * shadowing(where[here, :2], 4.0, np.random.default_rng([seed, k, f]))
    rssi = np.round(rssi + 3.0 * rng.standard_normal(len(t)))
    s = np.arange(0.0, t[-1], 0.2)
    pressure = 98_000 * np.exp(-walked(s)[:, 2] / SCALE_M) + 2.0 * rng.standard_normal(len(s)) + 0.05 * s
    heard = pl.DataFrame(
        {"t_ns": (t * 1e9).astype(np.int64), "mac": [MACS[k] for k in who], "rssi_dbm": rssi}
    )
    air = pl.DataFrame({"t_ns": (s * 1e9).astype(np.int64), "pressure_pa": pressure})
    return {"radio": {"/r": heard}, "pressure": {"/p": air}}


def building(stairs: bool = False) -> dict[str, bytes]:
    rows = "".join(
        f"{m},ble,{x},{y},{STOREY_M * f + 2.6},-58,1.8,{f}\n"
        for m, (x, y, f) in zip(MACS, ANCHORS, strict=True)
    )
    attachments = {"anchors.csv": f"mac,technology,x,y,z,p_d0,eta,floor\n{rows}".encode()}
    if stairs:
        outline = {"type": "Polygon", "coordinates": [[[0, 0], [24, 0], [24, 8], [0, 8], [0, 0]]]}
        features = [
            {"type": "Feature", "properties": {"kind": kind}, "geometry": shape}
            for kind, shape in (("passable", outline), ("stairs", STAIRS))
        ]
        plan = {"type": "FeatureCollection", "storey_m": STOREY_M, "features": features}
        attachments["plan.geojson"] = json.dumps(plan).encode()
    return attachments


@pytest.mark.parametrize(
    ("inputs", "stairs"),
    [(("radio",), False), (("radio",), True), (("radio", "pressure"), False), (("radio", "pressure"), True)],
)
def test_a_walk_over_two_floors(inputs: tuple[str, ...], stairs: bool) -> None:
    """The floor is right away from the stairs, its change is said once, and the place is as good as on one floor."""
    tables = {k: v for k, v in two_floors().items() if k in inputs}
    out = drive(make("indoor.fused", seed=2), tables, attachments=building(stairs))
    t = out["floor"]["t_ns"].to_numpy() / 1e9
    true = walked(t)
    settled = (t > 8) & (np.abs(t - UP_S - STAIRS_S / 2) > STAIRS_S / 2 + 5)
    right = out["floor"]["floor"].to_numpy() == (true[:, 2] > STOREY_M / 2)
    assert right[settled].mean() > 0.95
    (change,) = out["change"].filter(pl.col("t_ns") > 8e9).iter_rows(named=True)
    assert (change["from"], change["to"]) == (0.0, 1.0)
    assert change["t_ns"] / 1e9 == pytest.approx(UP_S + STAIRS_S / 2, abs=9.0)
    place = out["position"].select("pos_x", "pos_y", "pos_z").to_numpy()
    at = walked(out["position"]["t_ns"].to_numpy() / 1e9)
    late = out["position"]["t_ns"].to_numpy() > 8e9
    assert np.linalg.norm(place[late, :2] - at[late, :2], axis=1).mean() < 3.5
    assert place[-1, 2] == pytest.approx(STOREY_M + 1.2)


def test_the_barometer_alone_tells_the_floor_where_no_anchor_does() -> None:
    """All anchors are downstairs and silent from the stairs on: steps of the pressure are what is left."""
    about = building(stairs=True)
    rows = about["anchors.csv"].decode().splitlines()
    about["anchors.csv"] = "\n".join(rows[:4]).encode()
    plan = json.loads(about["plan.geojson"])
    for floor in (0, 1):
        plan["features"].append({**plan["features"][0], "properties": {"kind": "passable", "floor": floor}})
    about["plan.geojson"] = json.dumps(plan).encode()
    tables = two_floors()
    below = tables["radio"]["/r"].filter((pl.col("t_ns") < UP_S * 1e9) & pl.col("mac").is_in(MACS[:3]))
    out = drive(make("indoor.fused", seed=2), {**tables, "radio": {"/r": below}}, attachments=about)
    change = out["change"].row(-1, named=True)
    assert (change["to"], out["floor"]["floor"][-1]) == (1.0, 1.0)
    assert change["t_ns"] / 1e9 == pytest.approx(UP_S + STAIRS_S / 2, abs=9.0)


def test_a_known_start_says_its_floor_and_one_that_is_not_there_is_refused() -> None:
    tables = {"radio": two_floors()["radio"]}
    params = {"known_start": True, "start_x": 3.0, "start_y": 4.0}
    out = drive(make("indoor.fused", start_floor=0, **params), tables, attachments=building())
    assert out["floor"]["floor"][0] == 0.0
    with pytest.raises(AlgorithmError, match="floors 0 to 1"):
        drive(make("indoor.fused", start_floor=4, **params), tables, attachments=building())


def test_one_floor_states_none() -> None:
    tables = {"radio": two_floors()["radio"]}
    about = {"anchors.csv": b"\n".join(building()["anchors.csv"].splitlines()[:4])}
    estimator = make("indoor.fused")
    out = drive(estimator, tables, attachments=about)
    assert out["floor"].is_empty()
    assert out["change"].is_empty()


NAN = float("nan")


@pytest.mark.parametrize(
    ("height", "floor", "plan", "numbers", "of_anchor", "above"),
    [
        ([2.6, 6.0], [0, 1], {}, [0, 1], [0, 1], [2.6, 2.6]),
        ([2.6, 2.6], [0, 1], {}, [0, 1], [0, 1], [2.6, 2.6]),  # above its own floor
        ([2.6, 2.6], [-1, 1], {}, [-1, 0, 1], [0, 2], [2.6, 2.6]),
        ([2.6, 5.6], [NAN, NAN], {"storey_m": "3"}, [0, 1], [0, 1], [2.6, 2.6]),
        ([2.6, 6.0], [NAN, NAN], {}, [0], [0, 0], [2.6, 6.0]),  # nothing says floors
        ([NAN, NAN], [3, 3], {}, [3], [0, 0], [NAN, NAN]),
    ],
)
def test_floors_of_anchors(height, floor, plan, numbers, of_anchor, above) -> None:
    storeys = storeys_of(np.array(height), np.array(floor, dtype=float), {}, plan)
    assert storeys.numbers == numbers
    assert storeys.of_anchor.tolist() == of_anchor
    np.testing.assert_allclose(storeys.above, above, atol=1e-9)
    tall = any(r.kind == "heights_without_floors" for r in storeys.remarks)
    assert tall == (numbers == [0] and height[1] > 5)
