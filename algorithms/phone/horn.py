"""Horn's closed-form transforms from local to global points (Horn 1987; phone dissertation, section 3.3).

Always a rotation, never a reflection: a mirrored track stays mirrored and shows it by its residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..contract import AlgorithmError, FloatArray


@dataclass(frozen=True)
class Similarity:
    """``global = scale · rotation @ local + shift``.

    Attributes
    ----------
    rotation : ndarray
        Shape (d, d), determinant +1.
    scale : float
        1 where none was asked for.
    shift : ndarray
        Shape (d,), in the unit of the global points.
    rms : float
        Root of the mean squared distance that is left.
    """

    rotation: FloatArray
    scale: float
    shift: FloatArray
    rms: float

    def apply(self, points: FloatArray) -> FloatArray:
        """Return the transformed points, shape (n, d)."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.shift


def horn(
    local: FloatArray, target: FloatArray, *, scale: bool = True, weights: FloatArray | None = None
) -> Similarity:
    """Return the transform that takes ``local`` to ``target`` with the least squared distances.

    In the plane ``sR = Σ g' conj(l') / Σ |l'|²`` with the points as complex numbers about their centroids; in
    space the unit quaternion of the largest eigenvalue of Horn's 4×4 matrix. With scale, distances are measured
    in the global frame (the asymmetric scale of Horn, eq 3.50).

    Parameters
    ----------
    local, target : ndarray
        Pairs of points, shape (n, 2) or (n, 3).
    scale : bool
        Whether to find a scale.
    weights : ndarray, optional
        Of the pairs, shape (n,), not negative.

    Raises
    ------
    AlgorithmError
        Fewer than two pairs (three in space), or all local points are one.
    """
    a, b = np.asarray(local, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] not in (2, 3):
        raise AlgorithmError(f"horn: points are (n, 2) or (n, 3) in pairs, not {a.shape} and {b.shape}")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    d = a.shape[1]
    if np.count_nonzero(w) < d:
        raise AlgorithmError(f"horn: {np.count_nonzero(w)} pairs of points; at least {d} are needed")
    w = w / w.sum()
    ca, cb = w @ a, w @ b
    p, q = a - ca, b - cb
    power = float(w @ (p * p).sum(axis=1))
    if power <= 1e-24 * max(1.0, float(ca @ ca)):
        raise AlgorithmError("horn: all local points are one: no rotation can be found")
    if d == 2:
        z, g = p[:, 0] + 1j * p[:, 1], q[:, 0] + 1j * q[:, 1]
        cross = complex(w @ (g * z.conj()))
        size = abs(cross)
        c, s = (cross.real / size, cross.imag / size) if size > 0 else (1.0, 0.0)
        rotation = np.array([[c, -s], [s, c]])
        factor = size / power
    else:
        m = p.T @ (w[:, None] * q)
        rotation = _rotation_of(m)
        factor = float(np.trace(rotation @ m)) / power
    k = factor if scale else 1.0
    shift = cb - k * rotation @ ca
    left = b - (k * a @ rotation.T + shift)
    return Similarity(rotation, float(k), shift, float(np.sqrt(w @ (left * left).sum(axis=1))))


def _rotation_of(m: FloatArray) -> FloatArray:
    """Return the rotation that maximizes trace(R M): Horn's quaternion of the largest eigenvalue."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = m
    n = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    w, x, y, z = np.linalg.eigh(n)[1][:, -1]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
