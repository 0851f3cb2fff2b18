"""What the importers of optical captures share: rows of numbers as arrays, and arrays as blocks of channels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import MarchaError, UsageError
from .anatomy import ReferenceAngles, from_markers
from .columns import MISSING
from .contract import ChannelSpec, CommonOptions, Import, ReportBuilder
from .leg import JOINTS, MARKERS, MARKERS_TOPIC, ORIENTATION, QUAT, rotations, unseen
from .timestamps import TimestampRepair

FloatArray = NDArray[np.float64]
TimedTables = tuple[NDArray[np.int64], NDArray[np.int64], Sequence[tuple[str, pl.DataFrame]]]
"""Rows of one clock: time (ns) and line of each, and topics with their columns, as many rows."""
ROWS = 8192
"""Rows of a block."""
HEAD_ROWS = 32_768
"""First frames of a capture, which say what is constant in it: shapes of clusters, sides, axes, where zero is."""
ANGLES_TOPIC = "/reference/optical/joint"
"""Angles made of markers; what a file itself says of angles is ``/reference/joint``."""


def float_windows(
    path: Path,
    pieces: Iterable[tuple[int, Sequence[str]]],
    separator: str,
    names: Sequence[str],
    report: ReportBuilder,
) -> Iterator[tuple[FloatArray, NDArray[np.int64]]]:
    """Yield rows of numbers (n, columns) and their lines piece by piece; a missing cell is NaN.

    Rows with more cells than ``names``, or without a number in the first column, are dropped (``bad_row``); a
    cell that is no number becomes NaN (repair ``missing_cell``). Blank lines are nothing.

    Parameters
    ----------
    path : Path
        The file, for messages.
    pieces : iterable of (int, sequence of str)
        Number of the first line, and lines, as :func:`marcha.ingest.text.text_lines` yields them.
    separator : str
        Between cells; a blank stands for runs of blanks and tabs.
    names : sequence of str
        Of the columns.
    report : ReportBuilder
        Takes what is found.

    Raises
    ------
    MarchaError
        No row is left at the end.
    """
    empty = True
    for first_line, lines in pieces:
        values, rows = _window(lines, first_line, separator, names, report)
        if rows.size:
            empty = False
            yield values, rows
    if empty:
        raise MarchaError(f"{path}: no row of numbers behind its header; nothing to convert")


def _window(
    lines: Sequence[str], first_line: int, separator: str, names: Sequence[str], report: ReportBuilder
) -> tuple[FloatArray, NDArray[np.int64]]:
    width = len(names)
    line = np.arange(first_line, first_line + len(lines), dtype=np.int64)
    text = pl.Series(lines, dtype=pl.String).str.strip_chars_end(" ")
    if separator == " ":
        text = text.str.strip_chars().str.replace_all(r"[ \t]+", " ")
    blank = (text.str.strip_chars(" \t,;") == "").to_numpy()
    cells = (text.str.count_matches(separator, literal=True) + 1).to_numpy().astype(np.int64)
    if (cells > width).any():  # what is only separators at the end of a line is nothing
        body = text.str.strip_chars_end(f" {separator}")
        filled = (body.str.count_matches(separator, literal=True) + 1).to_numpy().astype(np.int64)
        cells = np.where((cells > width) & (filled <= width), width, cells)
    bad = ~blank & (cells > width)
    good = np.flatnonzero(~blank & ~bad)
    values = np.empty((0, width))
    if good.size:
        # A first line as wide as the table, so that short rows are filled and long ones cut.
        body = "\n".join([separator.join(["x"] * width), *text.gather(good).to_list()])
        frame = pl.read_csv(
            body.encode(),
            separator=separator,
            has_header=False,
            infer_schema=False,
            truncate_ragged_lines=True,
            quote_char=None,
        )[1:]
        frame = frame.select(pl.all().str.strip_chars())
        values = frame.select(pl.all().cast(pl.Float64, strict=False).fill_null(np.nan)).to_numpy(
            writable=True
        )
        values[~np.isfinite(values)] = np.nan
        for k in (np.flatnonzero(np.isnan(values[:, 1:]).any(axis=0)) + 1).tolist():
            name, cell = names[k], frame[:, k]
            odd = ~cell.str.to_lowercase().is_in(MISSING).fill_null(True).to_numpy() & np.isnan(values[:, k])
            if odd.any():
                first = int(np.argmax(odd))
                report.repair(
                    "missing_cell",
                    f"{name}: {cell[first]!r} is not a number: taken as missing",
                    count=int(odd.sum()),
                    line=int(line[good[first]]),
                    subject=f"{name} unreadable",
                )
        without = np.isnan(values[:, 0])
        bad[good[without]] = True
        values, good = values[~without], good[~without]
    if bad.any():
        first = int(np.argmax(bad))
        report.drop(
            "bad_row",
            f"{lines[first][:40]!r}: not {width} cells that begin with a number; row dropped",
            count=int(bad.sum()),
            line=int(line[first]),
        )
    return values, line[good]


def blocks_of(windows: Iterable[TimedTables], report: ReportBuilder) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield tables of one clock block by block, times repaired and checked.

    Parameters
    ----------
    windows : iterable of TimedTables
        The rows, window by window, of the same topics and columns.
    report : ReportBuilder
        Takes what is found.
    """
    plan: list[tuple[str, list[str]]] = []

    def frames() -> Iterator[pl.DataFrame]:
        for t_ns, lines, tables in windows:
            plan[:] = [(topic, table.columns) for topic, table in tables]
            wide = [c.alias(f"{k} {c.name}") for k, (_, table) in enumerate(tables) for c in table]
            yield pl.DataFrame({"t": t_ns, "line": lines}).hstack(wide)

    for block in TimestampRepair(report, tick_ns=1).stream(_of_rows(frames(), ROWS)):
        for k, (topic, columns) in enumerate(plan):
            yield topic, block.select("t_ns", *(pl.col(f"{k} {c}").alias(c) for c in columns))


def _of_rows(frames: Iterable[pl.DataFrame], rows: int, first: int | None = None) -> Iterator[pl.DataFrame]:
    """Yield the rows of frames in frames of ``rows``, the first of ``first``: they do not depend on how they came."""
    size, rest = first or rows, None
    for frame in frames:
        rest = frame if rest is None else pl.concat([rest, frame])
        while rest.height >= size:
            yield rest[:size].rechunk()
            rest, size = rest[size:], rows
    if rest is not None and rest.height:
        yield rest.rechunk()


def beside_each_other(left: Iterable[pl.DataFrame], right: Iterable[pl.DataFrame]) -> Iterator[pl.DataFrame]:
    """Yield frames with the columns of both, which are as many rows in pieces of their own."""
    for one, other in zip(_of_rows(left, ROWS), _of_rows(right, ROWS), strict=True):
        yield one.hstack(other.drop("t", "line"))


def marker_columns(names: Sequence[str]) -> list[str]:
    """Return the columns of markers."""
    return [f"{n}.{a}" for n in names for a in "xyz"]


def marker_table(names: Sequence[str], pos: FloatArray) -> pl.DataFrame:
    """Return markers (n, m, 3) in metres as the columns of :data:`MARKERS`."""
    return pl.DataFrame(
        {c: np.ascontiguousarray(pos[:, k // 3, k % 3]) for k, c in enumerate(marker_columns(names))}
    )


class MarkerOptions(CommonOptions, frozen=True, kw_only=True):
    """How reference angles are made of markers.

    Attributes
    ----------
    angles : str
        Definition of the reference angles.
    landmarks : str or None
        Which marker is which landmark.
    side : str or None
        Whose angles have no side in their names.
    """

    angles: Annotated[
        Literal["isb", "source", "off"],
        msgspec.Meta(
            description="reference angles from the markers: isb (Cardan angles of landmarks' frames), source (long "
            "axes in the sagittal plane), or off; docs/joints.md"
        ),
    ] = "isb"
    landmarks: Annotated[
        str | None,
        msgspec.Meta(
            description="which marker is which landmark, beside those known by name: "
            "RLE:right_knee_lat,RME:right_knee_med"
        ),
    ] = None
    side: Annotated[
        Literal["left", "right"] | None,
        msgspec.Meta(
            description="leg that the sensors are on: its angles are called knee, not left_knee; the other leg's "
            "keep their side"
        ),
    ] = None


def marker_import(
    frames: Iterable[pl.DataFrame],
    names: Sequence[str],
    report: ReportBuilder,
    device: dict[str, str],
    options: MarkerOptions,
    more: Sequence[ChannelSpec] = (),
) -> Import:
    """Return the import of a capture of markers, of channels ``more`` at the same times, and of its angles.

    Parameters
    ----------
    frames : iterable of polars.DataFrame
        ``t`` (ns), ``line``, ``<marker>.x`` … (m) as :func:`marker_columns` has them, and ``<topic> <column>`` of
        ``more``; at least one.
    names : sequence of str
        Of the markers.
    report : ReportBuilder
        Takes what is found.
    device : dict
        Metadata of the device.
    options : MarkerOptions
        How angles are made.
    more : sequence of ChannelSpec
        Channels, their columns named.
    """
    windows = _of_rows(frames, ROWS, HEAD_ROWS)
    reference = _Reference(names, options, report)
    head = next(windows)
    waiting = [(head, reference.of(head))]  # popped when it is read: closures hold what they name
    own = ChannelSpec(MARKERS_TOPIC, MARKERS, "optical", tuple(marker_columns(names)))
    specs = [own, *more, *(spec for spec, _ in waiting[0][1])]

    def windowed() -> Iterator[tuple[pl.DataFrame, list[tuple[ChannelSpec, pl.DataFrame]]]]:
        yield waiting.pop()
        yield from ((frame, reference.of(frame)) for frame in windows)

    def tables() -> Iterator[TimedTables]:
        for frame, angles in windowed():
            by_topic = {spec.topic: table for spec, table in angles}
            by_topic[own.topic] = frame
            by_topic |= {
                s.topic: frame.select(pl.col(f"{s.topic} {c}").alias(c) for c in s.columns) for s in more
            }
            yield (
                frame["t"].to_numpy(),
                frame["line"].to_numpy(),
                [(s.topic, by_topic[s.topic].select(s.columns)) for s in specs],
            )
        reference.finish()

    turning = [s.topic for s in specs if s.schema == ORIENTATION]
    return Import(
        channels=specs,
        blocks=rotations(unseen(blocks_of(tables(), report), report), turning, report),
        report=report,
        metadata={"device": {"clock": "device", "frames": "as the capture system has them", **device}},
    )


def _roles(landmarks: str) -> dict[str, str]:
    """Return the landmark of each marker that the option names."""
    roles = {}
    for pair in filter(None, landmarks.replace(" ", "").split(",")):
        marker, colon, role = pair.partition(":")
        if not colon:
            raise UsageError(
                f"option landmarks: {pair!r} is no MARKER:LANDMARK pair, such as RLE:right_knee_lat"
            )
        roles[marker] = role
    return roles


class _Reference:
    """What markers say of joints and segments, window by window: the first says what is constant in the capture."""

    def __init__(self, names: Sequence[str], options: MarkerOptions, report: ReportBuilder) -> None:
        self._names, self._options, self._report = names, options, report
        self._roles = {} if options.angles == "off" else _roles(options.landmarks or "")
        self._constants: dict[Any, Any] = {}
        self._rows = self._hidden = 0
        self._first_hidden: tuple[int, int] | None = None
        self._remarks: dict[str, str] = {}
        self._lost: dict[str, int] = {}

    def of(self, frame: pl.DataFrame) -> list[tuple[ChannelSpec, pl.DataFrame]]:
        """Return ``/reference/optical/joint`` and ``…/<segment>/orientation`` of a window, as markers say them."""
        pos = frame.select(marker_columns(self._names)).to_numpy().reshape(frame.height, -1, 3)
        hidden = np.isnan(pos).any(axis=2)
        if hidden.any() and self._first_hidden is None:
            row, k = (int(i[0]) for i in np.nonzero(hidden))
            self._first_hidden = self._rows + row, k
        self._hidden += int(hidden.sum())
        head = not self._rows
        self._rows += frame.height
        if self._options.angles == "off":
            return []
        seen = np.where((pos == 0).all(axis=2, keepdims=True), np.nan, pos)
        angles = self._angles(frame["t"].to_numpy(), seen)
        if head:
            self._remarks = angles.remarks
            for doubt in angles.doubts:
                self._report.note("reference_doubt", doubt, subject=doubt)
        for name in self._remarks:
            self._lost[name] = self._lost.get(name, 0) + int((~np.isfinite(angles.angle[name])).sum())
        return reference_channels(angles)

    def _angles(self, t_ns: NDArray[np.int64], seen: FloatArray) -> ReferenceAngles:
        t, how = t_ns.astype(np.float64) * 1e-9, self._options.angles
        try:
            angles = from_markers(t, self._names, seen, how, self._roles, self._constants)
        except ValueError as error:
            raise UsageError(f"option landmarks: {error}") from None
        if self._options.side is None:
            return angles
        start = f"{self._options.side}_"
        return ReferenceAngles(
            angle={name.removeprefix(start): v for name, v in angles.angle.items()},
            rot={name.removeprefix(start): v for name, v in angles.rot.items()},
            remarks={name.removeprefix(start): v for name, v in angles.remarks.items()},
            doubts=angles.doubts,
        )

    def finish(self) -> None:
        """Say how much was not seen, and by which definition the angles are."""
        if self._first_hidden is not None:
            row, k = self._first_hidden
            share = 100 * (self._hidden / (self._rows * len(self._names)))
            self._report.note(
                "missing_cell",
                f"{MARKERS_TOPIC}: {share:.2g} % of the positions are missing (first {self._names[k]}): NaN",
                count=self._hidden,
                line=row + 1,
                subject="hidden",
            )
        for name, remark in self._remarks.items():
            share = 100.0 * (self._lost[name] / self._rows)
            self._report.note(
                "reference_angle",
                f"{ANGLES_TOPIC} {name}: {remark}; {share:.2g} % of the frames without",
                subject=name,
            )


def reference_channels(angles: ReferenceAngles) -> list[tuple[ChannelSpec, pl.DataFrame]]:
    """Return the channels of reference angles and attitudes."""
    from scipy.spatial.transform import Rotation

    channels = []
    if angles.angle:
        table = pl.DataFrame(angles.angle)
        metadata = {"sign": "upper - lower segment", **angles.remarks}
        channels.append((ChannelSpec(ANGLES_TOPIC, JOINTS, "", tuple(table.columns), metadata), table))
    for segment, rot in angles.rot.items():
        quat = np.full((len(rot), 4), np.nan)
        good = np.isfinite(rot).all(axis=(1, 2))
        if good.any():
            quat[good] = Rotation.from_matrix(rot[good]).as_quat(canonical=True, scalar_first=True)
        table = pl.DataFrame({c: quat[:, k] for k, c in enumerate(QUAT)})
        axes = {"frame": "x right, y forward, z up along the segment, from landmarks (docs/joints.md)"}
        topic = f"/reference/optical/{segment}/orientation"
        channels.append((ChannelSpec(topic, ORIENTATION, "optical", QUAT, axes), table))
    return channels
