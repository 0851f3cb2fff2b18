"""The local track laid on the fixes by Horn's transform, as the dissertation does it (offline)."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import (
    ALL_COLUMNS,
    AlgorithmError,
    Context,
    Input,
    Message,
    Output,
    PlainEstimator,
    Remark,
    Result,
)
from ..parameters import meta
from . import geodesy
from .horn import horn
from .pdr import FIX, POSE, encode_fixes


class TransformParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the local track is laid on the fixes."""

    scale: Annotated[
        bool, meta("Whether the track may be stretched", source="phone dissertation, eq 3.50")
    ] = True
    pairing: Annotated[
        Literal["interpolate", "nearest"],
        meta(
            "Local point of a fix: between the poses about it, or the pose next to it in time",
            source="phone dissertation, section 3.3: the step with the same time stamp",
        ),
    ] = "interpolate"
    weighted: Annotated[bool, meta("Weigh fixes by their stated variance", source="ours")] = False


def _turned(half: Any, quat: Any) -> tuple[float, ...]:
    """Return an orientation (w, x, y, z) turned about the vertical; ``half``: cosine, sine of half the angle."""
    (c, s), (w, x, y, z) = half.tolist(), quat.tolist()
    return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w


class PhoneTransform(PlainEstimator):
    """Horn's transform in the plane from the local track to UTM, over the whole walk. Never a reflection.

    The stated deviation is the root of the mean squared residual an axis. ``rotation_rad`` takes the local track
    to grid north, anticlockwise; a track whose y is true north is turned by the grid convergence there
    (``convergence_rad``), which is no error: ``north_error_rad`` is what is left. ``pose`` is in metres east and
    true north of the first fix, as of ``phone.fused``: grid convergence and point scale are taken off again.
    """

    name: ClassVar[str] = "phone.transform"
    title: ClassVar[str] = "local track laid on the fixes (Horn), offline"
    source: ClassVar[str] = "phone dissertation, section 3.3; Horn 1987"
    offline: ClassVar[bool] = True
    Params = TransformParams
    inputs = (
        Input("pose", POSE.schema, POSE.columns, stage="phone.pdr-source"),
        Input("gnss", "sensor_msgs/msg/NavSatFix", ALL_COLUMNS),
    )
    outputs = (
        FIX,
        POSE,
        Output(
            "transform",
            "marcha_msgs/msg/NamedValues",
            (
                "rotation_rad",
                "scale",
                "shift_east_m",
                "shift_north_m",
                "rms_m",
                "pairs",
                "zone",
                "convergence_rad",
                "point_scale",
                "north_error_rad",
            ),
        ),
    )

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.poses: list[tuple[int, Any]] = []
        self.fixes: list[tuple[int, Any]] = []
        self.columns: tuple[str, ...] = ()
        self.failed = ""

    def start(self, context: Context) -> None:
        """Note the columns of the fixes."""
        attached = context.channels.get("gnss")
        self.columns = attached[0].columns if attached else ()
        self.poses, self.fixes, self.failed = [], [], ""

    def take(self, message: Message) -> None:
        """Keep the message."""
        (self.poses if message.input == "pose" else self.fixes).append((message.t_ns, message.values))

    def finish(self) -> list[Result]:
        """Return the track on the Earth."""
        import polars as pl

        poses, fixes = self.poses, self.fixes
        self.poses, self.fixes = [], []
        if not poses and not fixes:
            return []
        table = pl.DataFrame(
            [v for _, v in fixes], schema=list(self.columns), orient="row", infer_schema_length=None
        )
        seen = encode_fixes(table.insert_column(0, pl.Series("t_ns", [t for t, _ in fixes], dtype=pl.Int64)))
        t = np.array([t for t, _ in poses], np.int64)
        local = np.array([v[:2] for _, v in poses], dtype=np.float64).reshape(-1, 2)
        when = np.array([t for t, _ in fixes], np.int64)
        good = np.isfinite(seen[:, 0]) & np.isfinite(seen[:, 1])
        if len(t):  # the track says nothing about fixes far before or after it
            good &= (when >= t[0] - 1_000_000_000) & (when <= t[-1] + 1_000_000_000)
        if len(t) < 2 or good.sum() < 2:
            self.failed = (
                f"{len(t)} poses and {int(good.sum())} fixes beside them; at least two of each are needed"
            )
            return []
        seen, when = seen[good], when[good]
        grid = geodesy.utm(np.degrees(seen[:, 0]), np.degrees(seen[:, 1]))
        zero = t[0]
        if self.params.pairing == "interpolate":
            pairs = np.column_stack([np.interp(when - zero, t - zero, local[:, k]) for k in range(2)])
        else:
            after = np.clip(np.searchsorted(t, when), 1, len(t) - 1)
            pairs = local[np.where(when - t[after - 1] <= t[after] - when, after - 1, after)]
        weights = None
        if self.params.weighted and np.isfinite(seen[:, 3]).all() and (seen[:, 3] > 0).all():
            weights = 1 / seen[:, 3] ** 2
        target = np.column_stack((grid.east_m, grid.north_m))
        try:
            fitted = horn(pairs, target, scale=self.params.scale, weights=weights)
        except AlgorithmError as error:
            self.failed = str(error)
            return []
        quats = np.array([v[3:] for _, v in poses], dtype=np.float64)
        alt = float(np.nanmean(seen[:, 2])) if np.isfinite(seen[:, 2]).any() else math.nan
        return self._results(t, fitted.apply(local), quats, fitted, grid, len(when), alt)

    def _results(
        self, t: Any, place: Any, quats: Any, fitted: Any, grid: geodesy.Grid, pairs: int, alt: float
    ) -> list[Result]:
        lat, lon = geodesy.from_utm(grid.zone, grid.south, place[:, 0], place[:, 1])
        sd, origin = fitted.rms / math.sqrt(2), np.array([grid.east_m[0], grid.north_m[0]])
        turn = math.atan2(fitted.rotation[1, 0], fitted.rotation[0, 0])
        convergence, scale = float(grid.convergence_rad[0]), float(grid.scale[0])
        north_error = math.remainder(turn - convergence, 2 * math.pi)
        about = (
            turn,
            fitted.scale,
            *fitted.shift.tolist(),
            fitted.rms,
            pairs,
            grid.zone,
            convergence,
            scale,
            north_error,
        )
        c, w = math.cos(convergence) / scale, math.sin(convergence) / scale
        ground = (place - origin) @ np.array([[c, -w], [w, c]])
        half = np.array([math.cos(north_error / 2), math.sin(north_error / 2)])
        out = [Result("transform", int(t[0]), about)]
        for k, when in enumerate(t.tolist()):
            east, north = ground[k].tolist()
            quat = _turned(half, quats[k])
            out.append(Result("pose", when, (east, north, 0.0, *quat)))
            out.append(Result("fix", when, (float(lat[k]), float(lon[k]), alt, sd, sd, float("nan"))))
        return out

    def remarks(self) -> list[Remark]:
        """Say why there is no track."""
        return [Remark("not_transformed", self.failed, fatal=True)] if self.failed else []
