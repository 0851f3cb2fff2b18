"""Simulated captures of legs as files: the exoskeleton's CSV with its mapping, the cameras' TRC, the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from .leg import LegCapture
from .legmotion import FloatArray


def exo_csv(leg: LegCapture) -> bytes:
    """Return the capture as CSV: ``time`` (s), ``<segment>_acc_x`` … (m/s², rad/s), ``<joint>_enc`` (°)."""
    columns: dict[str, FloatArray] = {"time": leg.t}
    for name, s in leg.segments.items():
        for kind, values in (("acc", s.acc_b), ("gyr", s.gyr_b)):
            columns |= {f"{name}_{kind}_{a}": values[:, k] for k, a in enumerate("xyz")}
    columns |= {f"{name}_enc": np.degrees(joint.encoder) for name, joint in leg.joints.items()}
    return pl.DataFrame(columns).write_csv(float_precision=6).encode()


def exo_toml(leg: LegCapture) -> bytes:
    """Return the mapping of :func:`exo_csv`: nominal mounting, flexion about x."""
    segments = {name: {"mounting_wxyz": [1.0, 0.0, 0.0, 0.0]} for name in leg.segments}
    joints = {
        name: {"upper": joint.upper, "lower": joint.lower}
        for name, joint in leg.joints.items()
        if joint.upper in segments and joint.lower in segments
    }
    units = {"acc": "m/s2", "gyr": "rad/s", "enc": "deg"}
    return msgspec.toml.encode({"units": units, "segment": segments, "joint": joints})


def trc(leg: LegCapture, name: str) -> bytes:
    """Return the markers as TRC (mm) on the cameras' own clock; empty cells where a marker was hidden."""
    o = leg.optical
    rate = f"{leg.options.optical_rate_hz:.2f}"
    count = len(o.t_ns)
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{len(o.names)}\tmm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(o.names) + "\t\t",
        "\t\t" + "\t".join(f"{a}{k + 1}" for k in range(len(o.names)) for a in "XYZ"),
    ]
    columns: dict[str, Any] = {"frame": np.arange(1, count + 1), "time": o.t_ns * 1e-9}
    flat = (o.pos * 1000).reshape(count, -1)
    columns |= {f"c{k}": pl.Series(flat[:, k], nan_to_null=True) for k in range(flat.shape[1])}
    body = pl.DataFrame(columns).write_csv(separator="\t", include_header=False, float_precision=6)
    return ("\n".join(head) + "\n" + body).encode()


def truth_csv(leg: LegCapture) -> bytes:
    """Return the true joint angles (rad) and attitudes ``rot_ns`` (quaternions) at the inertial times."""
    from scipy.spatial.transform import Rotation

    columns: dict[str, NDArray[Any]] = {"t_ns": leg.t_ns}
    columns |= {f"joint.{name}": joint.angle for name, joint in leg.joints.items()}
    for name, s in leg.segments.items():
        quat = Rotation.from_matrix(s.rot_ns).as_quat(scalar_first=True)
        columns |= {f"{name}.quat_{a}": quat[:, k] for k, a in enumerate("wxyz")}
    return pl.DataFrame(columns).write_csv().encode()


def truth_toml(leg: LegCapture) -> bytes:
    """Return the facts: clocks, mountings, axes, places of joints, every parameter."""
    o = leg.options
    facts: dict[str, Any] = {
        "scenario": leg.scenario,
        "seed": leg.seed,
        "optical_offset_s": o.optical_offset_s,
        "optical_drift_ppm": o.optical_drift_ppm,
        "frame": "segments: x right (flexion axis), y forward, z up; angle = roll of upper - roll of lower",
        "options": {k: v for k, v in msgspec.to_builtins(o).items() if v is not None},
    }
    facts |= {
        name: {
            "rot_sb": s.rot_sb.ravel().tolist(),
            "lever_m": s.lever_s.tolist(),
            "axis_b": s.axis_b.tolist(),
            "bias_acc": s.bias_acc.tolist(),
            "bias_gyr": s.bias_gyr.tolist(),
        }
        for name, s in leg.segments.items()
    }
    for name, joint in leg.joints.items():
        places = {
            "from_joint_upper_m": joint.from_joint_upper_b.tolist(),
            "from_joint_lower_m": joint.from_joint_lower_b.tolist(),
        }
        facts[name] = {k: v for k, v in places.items() if np.isfinite(v).all()}
    return msgspec.toml.encode(facts)


def files(leg: LegCapture, folder: Path, stem: str) -> tuple[Mapping[Path, bytes], Mapping[Path, bytes]]:
    """Return the raw logs and the truth of a capture, file by file."""
    raw = {
        folder / f"{stem}.csv": exo_csv(leg),
        folder / f"{stem}.toml": exo_toml(leg),
        folder / f"{stem}.trc": trc(leg, f"{stem}.trc"),
    }
    truth = {folder / f"{stem}.truth.leg.csv": truth_csv(leg), folder / f"{stem}.truth.toml": truth_toml(leg)}
    return raw, truth
