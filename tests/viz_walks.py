"""Small recordings of phones outdoors, of radio indoors and of legs, with estimates as their domains write them."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SECOND = 1_000_000_000
EPOCH = 1_700_000_000 * SECOND
ORIGIN = (-22.82649, -47.07605)
POSE, POINT = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped"
ANCHORS = {
    "00:00:00:00:00:01": ("wifi", (12.0, 1.5, 2.6), -40.0, 2.43),
    "00:00:00:00:00:02": ("wifi", (1.5, 6.9, 2.6), -40.0, 2.12),
    "00:00:00:00:00:03": ("ble", (3.9, 1.5, 0.8), -57.5, 1.71),
    "00:00:00:00:00:04": ("ble", (8.1, 5.7, 0.8), -57.5, 1.61),
}


def xyz(prefix: str, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    return {f"{prefix}_{a}": values[:, i] for i, a in enumerate("xyz")}


def poses(t_ns: Any, xy: Floats, yaw: Floats) -> pl.DataFrame:
    zero = 0 * yaw
    return pl.DataFrame(
        {
            "t_ns": t_ns,
            **xyz("pos", np.column_stack([xy, zero])),
            "quat_w": np.cos(yaw / 2),
            "quat_x": zero,
            "quat_y": zero,
            "quat_z": np.sin(yaw / 2),
        }
    )


def phone(path: Path, seconds: int = 60) -> mr.Recording:
    """Write a walk round a corner with a phone: sensors, fixes, steps, track, heading, fused fixes, truth."""
    rng = np.random.default_rng(3)
    s = np.arange(seconds * 50) / 50.0
    t_ns = EPOCH + (s * 1e9).astype(np.int64)
    turn = s > seconds / 2
    yaw = np.where(turn, np.pi / 2, 0.2)
    speed = 1.3
    xy = np.cumsum(speed / 50.0 * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    acc = 0.3 * rng.normal(size=(len(s), 3))
    acc[:, 2] += 9.81 + 2.5 * np.sin(2 * np.pi * 1.8 * s)
    k = np.arange(0, len(s), 28)
    rough = yaw + 0.15 * rng.normal(size=len(s))
    metre = np.array([1 / 110_700.0, 1 / (111_320.0 * np.cos(np.radians(ORIGIN[0])))])
    f = np.arange(0, len(s), 250)
    fix = np.array(ORIGIN) + (xy[f][:, ::-1] + 4.0 * rng.normal(size=(len(f), 2))) * metre
    fused = np.array(ORIGIN) + xy[k][:, ::-1] * metre
    with mr.create(path) as out:
        out.add_metadata("device", {"clock": "utc"})
        table = pl.DataFrame({"t_ns": t_ns, **xyz("acc", acc), **xyz("gyr", 0.05 * acc)})
        out.add_table("/phone/imu", "sensor_msgs/msg/Imu", table, frame_id="phone")
        mag = np.column_stack([-np.sin(rough), np.cos(rough), 0 * s]) * 25e-6
        out.add_table(
            "/phone/mag", "sensor_msgs/msg/MagneticField", pl.DataFrame({"t_ns": t_ns, **xyz("mag", mag)})
        )
        out.add_table("/phone/gnss", "sensor_msgs/msg/NavSatFix", fixes(t_ns[f], fix, 5.0))
        out.add_table("/reference/pose", POSE, poses(t_ns, xy, yaw))
        own = poses(t_ns[k], xy[k] + 0.02 * np.arange(len(k))[:, None], yaw[k])
        run = "/estimate/phone_fused_phone_imu"
        out.add_table(f"{run}/pose", POSE, own)
        sigma = 0.5 + 0.03 * np.arange(len(k))
        table = pl.DataFrame(
            {"t_ns": t_ns[k], "sigma_pos_x": sigma, "sigma_pos_y": 2 * sigma, "sigma_pos_z": 1.0}
        )
        out.add_table(f"{run}/sigma", "marcha_msgs/msg/NavigationSigma", table)
        steps = {
            "start_ns": t_ns[k] - 500_000_000,
            "end_ns": t_ns[k],
            "index": np.arange(len(k), dtype=np.uint32),
            "length_m": 0.72 + 0.05 * rng.normal(size=len(k)),
            "height_m": 0 * sigma,
            "heading_rad": yaw[k],
        }
        out.add_table(f"{run}/step", "marcha_msgs/msg/Step", pl.DataFrame({"t_ns": t_ns[k], **steps}))
        heading = pl.DataFrame({"t_ns": t_ns[k], "magnetic_rad": rough[k], "walking_rad": yaw[k]})
        out.add_table(f"{run}/heading", "marcha_msgs/msg/NamedValues", heading)
        out.add_table(f"{run}/fix", "sensor_msgs/msg/NavSatFix", fixes(t_ns[k], fused, 2.0))
    return mr.open(path)


def fixes(t_ns: Any, lat_lon: Floats, sd: float) -> pl.DataFrame:
    known = {"alt_m": 600.0, "sd_east_m": sd, "sd_north_m": sd, "sd_up_m": 2 * sd}
    return pl.DataFrame({"t_ns": t_ns, "lat_deg": lat_lon[:, 0], "lon_deg": lat_lon[:, 1]}).with_columns(
        **{k: pl.lit(v) for k, v in known.items()}
    )


def indoor(path: Path, seconds: int = 40) -> mr.Recording:
    """Write a walk along a corridor between anchors: signals, ranges, positions, plan and truth."""
    rng = np.random.default_rng(4)
    s = np.arange(0, seconds, 0.1)
    t_ns = 5 * SECOND + (s * 1e9).astype(np.int64)
    xy = np.column_stack([1.0 + 10.0 * s / seconds, 3.0 + np.sin(s / 4)])
    macs = list(ANCHORS)
    heard = np.arange(len(s)) % len(macs)
    place = np.array([ANCHORS[m][1] for m in macs])
    gone = np.linalg.norm(np.column_stack([xy, 0 * s])[:, None, :] - place[None], axis=2)
    mine = gone[np.arange(len(s)), heard]
    power = np.array([ANCHORS[m][2] for m in macs])[heard] - 10 * np.array([ANCHORS[m][3] for m in macs])[
        heard
    ] * np.log10(mine)
    signals = pl.DataFrame(
        {"t_ns": t_ns, "mac": [macs[i] for i in heard], "rssi_dbm": power + 3 * rng.normal(size=len(s))}
    )
    w = np.arange(0, len(s), 50)
    each = np.repeat(w, len(macs))
    ranges = pl.DataFrame(
        {
            "t_ns": t_ns[each],
            "mac": macs * len(w),
            "distance_m": gone[w].ravel() * (1 + 0.15 * rng.normal(size=len(each))),
        }
    )
    csv = "mac,technology,x,y,z,p_d0,eta\n" + "".join(
        f"{m},{kind},{p[0]},{p[1]},{p[2]},{p0},{eta}\n" for m, (kind, p, p0, eta) in ANCHORS.items()
    )
    walls = {
        "type": "Polygon",
        "coordinates": [
            [[0, 0], [13, 0], [13, 8], [0, 8], [0, 0]],
            [[5, 6.5], [7, 6.5], [7, 8], [5, 8], [5, 6.5]],
        ],
    }
    with mr.create(path) as out:
        out.add_metadata("device", {"clock": "device"})
        out.add_table("/phone/radio", "marcha_msgs/msg/RadioSignal", signals)
        out.add_table("/reference/pose", POSE, poses(t_ns, xy, 0 * s))
        for run, noise in (("indoor_trilateration", 1.0), ("indoor_fused", 0.3)):
            at = xy[w] + noise * rng.normal(size=(len(w), 2))
            table = pl.DataFrame({"t_ns": t_ns[w], **xyz("pos", np.column_stack([at, 0.0 * w]))})
            out.add_table(f"/estimate/{run}/position", POINT, table)
            sigma = {
                f"sigma_pos_{a}": np.full(len(w), noise * k)
                for a, k in zip("xyz", (1.0, 0.6, 0.1), strict=True)
            }
            sigma_table = pl.DataFrame({"t_ns": t_ns[w], **sigma})
            out.add_table(f"/estimate/{run}/sigma", "marcha_msgs/msg/NavigationSigma", sigma_table)
        out.add_table("/estimate/indoor_trilateration/ranges", "marcha_msgs/msg/Ranging", ranges)
        out.add_attachment("anchors.csv", csv.encode(), "text/csv")
        out.add_attachment("plan.geojson", json.dumps(walls).encode(), "application/geo+json")
    return mr.open(path)


def with_picture(path: Path, target: Path) -> mr.Recording:
    """Copy the radio of an indoor recording, with a picture of the floor instead of its outlines."""
    from PIL import Image

    rec = mr.open(path)
    picture = io.BytesIO()
    pixels = np.zeros((80, 130, 3), np.uint8) + 90
    pixels[:10, :, 0] = 250  # red along the upper edge, which is the plan's largest y
    Image.fromarray(pixels).save(picture, "png")
    with mr.create(target) as out:
        out.add_table("/phone/radio", "marcha_msgs/msg/RadioSignal", rec.table("/phone/radio"))
        out.add_attachment("anchors.csv", rec.attachment("anchors.csv"), "text/csv")
        out.add_attachment("plan.png", picture.getvalue(), "image/png")
        out.add_attachment("plan.json", json.dumps({"metres_per_pixel": 0.1}).encode(), "application/json")
    return mr.open(target)


def roll(angle: Floats) -> dict[str, Floats]:
    zero = 0 * angle
    return {"quat_w": np.cos(angle / 2), "quat_x": np.sin(angle / 2), "quat_y": zero, "quat_z": zero}


def leg(path: Path, seconds: int = 12) -> mr.Recording:
    """Write thigh and shank that swing: sensors, encoder, optical reference and markers, and one run."""
    rng = np.random.default_rng(5)
    s = np.arange(seconds * 50) / 50.0
    t_ns = 2 * SECOND + (s * 1e9).astype(np.int64)
    thigh = np.radians(25.0) * np.sin(2 * np.pi * 0.8 * s)
    knee = np.radians(30.0) * (1 - np.cos(2 * np.pi * 0.8 * s)) + 0.05
    shank = thigh - knee
    run = "/estimate/joint_smea"
    ref = slice(None, None, 2)
    with mr.create(path) as out:
        out.add_metadata("device", {"clock": "device"})
        for name, angle in (("thigh", thigh), ("shank", shank)):
            acc = np.column_stack([0 * s, 9.81 * np.sin(angle), 9.81 * np.cos(angle)])
            acc += 0.2 * rng.normal(size=acc.shape)
            gyr = np.column_stack([np.gradient(angle, s), 0.0 * s, 0.0 * s])
            table = pl.DataFrame({"t_ns": t_ns, **xyz("acc", acc), **xyz("gyr", gyr)})
            out.add_table(f"/leg/{name}/imu", "sensor_msgs/msg/Imu", table)
            table = pl.DataFrame({"t_ns": t_ns[ref], **roll(angle[ref])})
            out.add_table(f"/reference/{name}", "geometry_msgs/msg/QuaternionStamped", table)
            table = pl.DataFrame({"t_ns": t_ns, **roll(angle + 0.02 * np.sin(s))})
            out.add_table(f"{run}/{name}", "geometry_msgs/msg/QuaternionStamped", table)
        joint = "sensor_msgs/msg/JointState"
        out.add_table("/leg/encoder", joint, pl.DataFrame({"t_ns": t_ns, "knee": knee + 0.03}))
        out.add_table("/reference/joint", joint, pl.DataFrame({"t_ns": t_ns[ref], "knee": knee[ref]}))
        estimate = knee + np.radians(1.5) * np.sin(s)
        out.add_table(f"{run}/joint", joint, pl.DataFrame({"t_ns": t_ns, "knee": estimate}))
        named = "marcha_msgs/msg/NamedValues"
        sigma = pl.DataFrame({"t_ns": t_ns, "knee": np.full(len(s), np.radians(1.2)), "thigh_roll": 0.01})
        out.add_table(f"{run}/sigma", named, sigma, metadata={"unit": "rad"})
        table = pl.DataFrame({"t_ns": t_ns, "thigh_roll": thigh, "shank_roll": shank})
        out.add_table(f"{run}/attitude", named, table, metadata={"unit": "rad"})
        state = np.clip(np.floor(1.5 + 1.5 * np.sin(2 * np.pi * 0.8 * s)), 0, 2)
        table = pl.DataFrame({"t_ns": t_ns, "state": state, "rho_thigh": np.abs(0.3 * np.sin(s))})
        out.add_table(f"{run}/jump", named, table, metadata={"states": "thigh,shank,all"})
        used = pl.DataFrame({"t_ns": t_ns, "thigh": (state != 1) * 1.0, "shank": (state != 0) * 1.0})
        out.add_table(f"{run}/use", named, used)
        shares = pl.DataFrame({"t_ns": t_ns, "thigh_roll": 0.3 + 0 * s, "thigh_roll_weighted": 0.2 + 0 * s})
        out.add_table(f"{run}/cross", named, shares)
        marks = {}
        for name, share in (("hip", 0.0), ("knee", 1.0)):
            marks |= {
                f"{name}.x": 0 * s,
                f"{name}.y": 0.42 * share * np.sin(thigh),
                f"{name}.z": -0.42 * share * np.cos(thigh),
            }
        table = pl.DataFrame({"t_ns": t_ns[ref], **{k: v[ref] for k, v in marks.items()}})
        out.add_table("/reference/markers", "marcha_msgs/msg/OpticalMarkers", table)
    return mr.open(path)
