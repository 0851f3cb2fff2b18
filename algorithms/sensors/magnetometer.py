"""Calibration of a magnetometer: hard and soft iron from turning it in a steady field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from ..calibration import Calibration, Calibrator, Stretch
from ..contract import AlgorithmError, FloatArray, Input
from ..parameters import meta

MAG = ("mag_x", "mag_y", "mag_z")
MICRO = 1e-6


class MagnetometerCalibrationParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the field is, and what is fitted."""

    field_t: Annotated[
        float,
        meta("True strength of the field; 0: the fitted ellipsoid's own size is kept", "T", ge=0.0, lt=1e-3),
    ] = 0.0
    soft_iron: Annotated[bool, meta("Whether scales and skew are fitted too, not the offset alone")] = True
    coverage: Annotated[
        float,
        meta(
            "Least share of the field's directions along the least covered axis (1/3: all alike)",
            "1",
            "ours",
            gt=0.0,
            lt=0.34,
        ),
    ] = 0.05


class MagnetometerCalibration(Calibrator):
    """Offset (hard iron) and symmetric matrix (soft iron) that put every reading on a sphere.

    ``‖M (m − b)‖ = F``; first the algebraic ellipsoid (Li and Griffiths 2004), then the residual of the norm by
    Gauss–Newton with Huber weights, so that disturbed readings do not bend it. The readings must point in all
    directions: turned about one axis only, b along that axis is not observable, and the verdict says so.
    """

    name: ClassVar[str] = "magnetometer"
    title: ClassVar[str] = "hard and soft iron from turning the sensor in a steady field"
    source: ClassVar[str] = "Li and Griffiths 2004, Geometric Modeling and Processing; Renaudin et al. 2010"
    Params: ClassVar[type[msgspec.Struct]] = MagnetometerCalibrationParams
    inputs = (Input("magnetometer", "sensor_msgs/msg/MagneticField", MAG, regular=True),)

    def calibrate(self, stretches: Sequence[Stretch]) -> Calibration:
        """Return the sphere that fits the readings.

        Raises
        ------
        AlgorithmError
            Fewer than 20 readings.
        """
        p: Any = self.params
        topic = stretches[0].channels["magnetometer"][0].topic
        field = (
            np.concatenate([s.tables["magnetometer"][0].select(MAG).to_numpy() for s in stretches]) / MICRO
        )
        if len(field) < 20:
            raise AlgorithmError(f"{topic}: {len(field)} readings are too few for a calibration; at least 20")
        centre, matrix, residual, jacobian = fit_sphere(field, p.soft_iron)
        strength = p.field_t / MICRO if p.field_t else 1.0 / np.cbrt(np.linalg.det(matrix))
        corrected = (field - centre) @ matrix.T
        direction = corrected / np.linalg.norm(corrected, axis=1, keepdims=True)
        spread = np.linalg.eigvalsh(np.cov(direction.T, bias=True))
        values = {
            "mag_offset_t": (centre * MICRO).tolist(),
            "mag_matrix": (matrix * strength).tolist(),
            "field_t": float(strength * MICRO),
            "residual_rms_t": float(np.sqrt(np.mean(residual**2)) * strength * MICRO),
            "coverage": float(spread[0]),
        }
        usable = bool(spread[0] >= p.coverage and np.isfinite(matrix).all())
        remarks = []
        if not usable:
            remarks.append(
                f"not observable: {100 * spread[0]:.1f} % of the directions lie along the least covered axis "
                f"(least {100 * p.coverage:g} %); turn the sensor about all axes"
            )
        covariance: dict[str, list[list[float]]] = {}
        if usable:
            noise = float(np.mean(residual**2))
            covariance["mag_offset_t"] = (
                np.linalg.inv(jacobian.T @ jacobian)[:3, :3] * noise * MICRO**2
            ).tolist()
        return Calibration(
            kind=self.name,
            subject=topic,
            values=values,
            covariance=covariance,
            remarks=remarks,
            usable=usable,
        )


def fit_sphere(field: FloatArray, soft_iron: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return centre b, symmetric matrix M with ‖M (m − b)‖ ≈ 1, the residuals of that norm, and their Jacobian.

    Parameters
    ----------
    field : ndarray, shape (n, 3)
        Readings, any unit.
    soft_iron : bool
        M is a multiple of the identity without it.
    """
    from scipy.optimize import least_squares

    middle = 0.5 * (field.max(axis=0) + field.min(axis=0))
    size = max(float(np.mean(np.linalg.norm(field - middle, axis=1))), 1e-9)
    unit = (field - middle) / size

    def parts(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not soft_iron:
            return x[:3], x[3] * np.eye(3)
        a, b, c, d, e, f = x[3:]
        return x[:3], np.array([[a, d, e], [d, b, f], [e, f, c]])

    def residual(x: FloatArray) -> FloatArray:
        centre, matrix = parts(x)
        return np.linalg.norm((unit - centre) @ matrix.T, axis=1) - 1.0

    start = np.concatenate(
        (_algebraic_centre(unit), [1.0] if not soft_iron else [1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    )
    plain = least_squares(residual, start)
    scale = max(1.4826 * float(np.median(np.abs(plain.fun))), 1e-9)
    solution = least_squares(residual, plain.x, loss="huber", f_scale=1.345 * scale)
    centre, matrix = parts(solution.x)
    return middle + size * centre, matrix / size, residual(solution.x), solution.jac / size


def _algebraic_centre(points: FloatArray) -> FloatArray:
    """Return the centre of the sphere that fits in the least-squares sense of its equation."""
    a = np.column_stack((2 * points, np.ones(len(points))))
    solution = np.linalg.lstsq(a, np.sum(points**2, axis=1), rcond=None)[0]
    return solution[:3] if np.linalg.norm(solution[:3]) < 3 else np.zeros(3)
