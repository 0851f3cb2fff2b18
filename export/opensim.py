"""OpenSim: orientations (.sto), joint angles (.mot), markers (.trc)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.rotations import QUAT
from ..recording.selection import Selection, selected_topics
from .facts import origin, pretty
from .files import write_files
from .series import Together, rate_hz, together

JOINTS = "sensor_msgs/msg/JointState"
MARKERS = "marcha_msgs/msg/OpticalMarkers"


class OpensimOptions(Selection, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of OpenSim files."""

    names: Annotated[
        tuple[str, ...],
        msgspec.Meta(description="TOPIC=NAME or JOINT=NAME: name in the model (tibia_r_imu, knee_angle_r)"),
    ] = ()
    flip: Annotated[
        tuple[str, ...],
        msgspec.Meta(description="joints (as named in the file) whose angle changes its sign"),
    ] = ()
    y_up: Annotated[
        bool, msgspec.Meta(description="turn the frame so that y is up, as models of OpenSim have it")
    ] = True


class OpensimExporter:
    """What the three have in common."""

    name: ClassVar[str]
    title: ClassVar[str]
    suffix: ClassVar[str]
    what: ClassVar[str]
    Options: ClassVar[type[msgspec.Struct]] = OpensimOptions

    def fits(self, rec: Recording, topic: str) -> bool:
        """Return whether a channel holds what is written."""
        raise NotImplementedError

    def text(self, data: Together, options: OpensimOptions) -> str:
        """Return the file."""
        raise NotImplementedError

    def _topics(self, rec: Recording, options: Any) -> list[str]:
        chosen = [t for t in selected_topics(rec, options) if self.fits(rec, t)]
        if not chosen:
            raise UsageError(
                f"{rec.path}: no chosen channel has {self.what}; marcha info lists what there is"
            )
        return chosen

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what has no place in the file; the side file names it."""
        topics = self._topics(rec, options)
        losses = [f"anything but {self.what}: {len(rec.channels) - len(topics)} channels are left out"]
        resampled = together(rec, topics, options).resampled
        if resampled:
            losses.append(
                f"several clocks: {', '.join(resampled)} are interpolated to the times of the others"
            )
        losses.append("the date: time counts from the recording's start")
        return losses

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the file and its side file; see :class:`marcha.export.Exporter`."""
        topics = self._topics(rec, options)
        data = together(rec, topics, options)
        shifted = data._replace(t_ns=data.t_ns - rec.start_ns)
        side = {
            **origin(rec),
            "topics": topics,
            "options": msgspec.to_builtins(options),
            "frame": "y up: x, y, z are x, z, −y of the recording" if options.y_up else "as in the recording",
            "not_in_the_file": self.losses(rec, options),
        }
        files = {
            path: self.text(shifted, options).encode(),
            path.with_name(path.name + ".json"): pretty(side),
        }
        return write_files(files, overwrite=overwrite)


def _names(options: OpensimOptions, columns: list[str]) -> dict[str, str]:
    """Return the name in the file of each topic, joint or marker; what is not named keeps its own."""
    names_given = {}
    for pair in options.names:
        key, sign, value = pair.partition("=")
        if not sign or not value.strip() or key.strip() not in columns:
            raise UsageError(f"option names: {pair!r}: must be KNOWN=NAME with one of {', '.join(columns)}")
        names_given[key.strip()] = value.strip()
    names = {
        k: names_given.get(k, "_".join(p for p in k.strip("/").split("/")).replace(" ", "_")) for k in columns
    }
    if len(set(names.values())) != len(names):
        raise UsageError(f"option names: two columns would have one name: {', '.join(names.values())}")
    return names


def _frame(columns: dict[str, Any], header: str) -> str:
    table = pl.DataFrame(columns)
    return header + table.write_csv(separator="\t", null_value="nan", float_scientific=False)


class StoExporter(OpensimExporter):
    """Orientations for OpenSense: one column of quaternions a sensor."""

    name = "sto"
    title = "OpenSim .sto of orientations (quaternions) for OpenSense"
    suffix = ".sto"
    what = "orientations"

    def fits(self, rec: Recording, topic: str) -> bool:
        """Return whether the channel has quaternions."""
        return set(QUAT) <= set(rec.channels[topic].columns)

    def text(self, data: Together, options: OpensimOptions) -> str:
        """Return the file; real part first, with every digit."""
        names = _names(options, list(data.columns))
        out = [
            f"DataRate={rate_hz(data.t_ns):.6f}\nDataType=Quaternion\nversion=3\nOpenSimVersion=4.5\nendheader\n",
            "\t".join(["time", *names.values()]) + "\n",
        ]
        columns = []
        for topic in names:
            q = np.column_stack([data.columns[topic][n] for n in QUAT])
            columns.append((_y_up(q) if options.y_up else q).tolist())
        for k, t in enumerate(data.t_ns.tolist()):
            cells = [",".join(map(repr, column[k])) for column in columns]
            out.append("\t".join([repr(t / 1e9), *cells]) + "\n")
        return "".join(out)


def _y_up(q: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return rotations into a frame with y up: turned by −90° about x."""
    s = np.sqrt(0.5)
    w, x, y, z = q.T
    return np.column_stack((s * (w + x), s * (x - w), s * (y + z), s * (z - y)))


class MotExporter(OpensimExporter):
    """Joint angles in degrees."""

    name = "mot"
    title = "OpenSim .mot of joint angles, in degrees"
    suffix = ".mot"
    what = "joint angles"

    def fits(self, rec: Recording, topic: str) -> bool:
        """Return whether the channel has joint angles."""
        return rec.channels[topic].schema == JOINTS

    def text(self, data: Together, options: OpensimOptions) -> str:
        """Return the file."""
        angles = {
            (name if len(data.columns) == 1 else f"{topic}/{name}"): values
            for topic, columns in data.columns.items()
            for name, values in columns.items()
            if not name.endswith((".vel", ".effort"))
        }
        names = _names(options, list(angles))
        if odd := set(options.flip) - set(names.values()):
            raise UsageError(f"option flip: {', '.join(sorted(odd))}: not among {', '.join(names.values())}")
        columns: dict[str, Any] = {"time": data.t_ns / 1e9}
        for key, name in names.items():
            columns[name] = np.rad2deg(angles[key]) * (-1.0 if name in options.flip else 1.0)
        header = f"Coordinates\nversion=1\nnRows={len(data.t_ns)}\nnColumns={len(columns)}\ninDegrees=yes\nendheader\n"
        return _frame(columns, header)


class TrcExporter(OpensimExporter):
    """Markers in metres."""

    name = "trc"
    title = "markers as .trc (OpenSim, Motion Analysis), in metres"
    suffix = ".trc"
    what = "markers"

    def fits(self, rec: Recording, topic: str) -> bool:
        """Return whether the channel has markers."""
        return rec.channels[topic].schema == MARKERS

    def text(self, data: Together, options: OpensimOptions) -> str:
        """Return the file; a marker that is not seen has empty cells.

        Rows end with a tab: OpenSim's reader drops an empty cell at the end of a line.
        """
        markers = [
            (
                name.removesuffix(".x") if len(data.columns) == 1 else f"{topic}/{name.removesuffix('.x')}",
                topic,
                name.removesuffix(".x"),
            )
            for topic, columns in data.columns.items()
            for name in columns
            if name.endswith(".x")
        ]
        names = _names(options, [key for key, _, _ in markers])
        rate = rate_hz(data.t_ns)
        count = len(data.t_ns)
        head = (
            "PathFileType\t4\t(X/Y/Z)\tmarcha.trc\n"
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
            f"{rate:.6f}\t{rate:.6f}\t{count}\t{len(markers)}\tm\t{rate:.6f}\t1\t{count}\n"
        )
        titles = "Frame#\tTime\t" + "\t\t\t".join(names.values()) + "\t\t\n"
        axes = "\t\t" + "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, len(markers) + 1)) + "\n\n"
        columns: dict[str, Any] = {"n": np.arange(1, count + 1), "t": data.t_ns / 1e9}
        for k, (_, topic, name) in enumerate(markers):
            x, y, z = (data.columns[topic][f"{name}.{a}"] for a in "xyz")
            for a, values in zip("xyz", (x, z, -y) if options.y_up else (x, y, z), strict=True):
                columns[f"{k}{a}"] = values
        table = pl.DataFrame(columns).with_columns(
            pl.selectors.float().fill_nan(None), end=pl.lit(None, pl.String)
        )
        return (
            head
            + titles
            + axes
            + table.write_csv(separator="\t", include_header=False, float_scientific=False)
        )
