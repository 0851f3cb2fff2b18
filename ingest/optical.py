"""What the importers of optical captures share: rows of numbers as arrays, and arrays as blocks of channels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

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
ANGLES_TOPIC = "/reference/optical/joint"
"""Angles made of markers; what a file itself says of angles is ``/reference/joint``."""


def read_text(path: Path) -> str:
    """Return a text file, line ends as LF.

    Raises
    ------
    MarchaError
        It cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error
    return (
        data.removeprefix(b"\xef\xbb\xbf")
        .decode("utf-8", "replace")
        .replace("\r\n", "\n")
        .replace("\r", "\n")
    )


def float_rows(
    path: Path,
    lines: Sequence[str],
    first_line: int,
    separator: str,
    names: Sequence[str],
    report: ReportBuilder,
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return all rows of numbers (n, columns) and their lines, as :func:`float_windows` reads them.

    Raises
    ------
    MarchaError
        No row is left.
    """
    return next(float_windows(path, [(first_line, lines)], separator, names, report))


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


def _of_rows(frames: Iterable[pl.DataFrame], rows: int) -> Iterator[pl.DataFrame]:
    """Yield the rows of frames in frames of equal length: what is found does not depend on how they were read."""
    rest: pl.DataFrame | None = None
    for frame in frames:
        whole = frame if rest is None else pl.concat([rest, frame], rechunk=True)
        end = whole.height // rows * rows
        yield from (whole[i : i + rows] for i in range(0, end, rows))
        rest = whole[end:]
    if rest is not None:
        yield rest


def marker_table(names: Sequence[str], pos: FloatArray) -> pl.DataFrame:
    """Return markers (n, m, 3) in metres as the columns of :data:`MARKERS`."""
    return pl.DataFrame(
        {
            f"{n}.{a}": np.ascontiguousarray(pos[:, k, j])
            for k, n in enumerate(names)
            for j, a in enumerate("xyz")
        }
    )


def note_hidden(names: Sequence[str], pos: FloatArray, report: ReportBuilder) -> None:
    """Say how much of the markers was not seen.

    Shape of ``pos``: (n, markers, 3).
    """
    hidden = np.isnan(pos).any(axis=2)
    if hidden.any():
        row, k = (int(i[0]) for i in np.nonzero(hidden))
        report.note(
            "missing_cell",
            f"{MARKERS_TOPIC}: {100 * hidden.mean():.2g} % of the positions are missing (first {names[k]}): NaN",
            count=int(hidden.sum()),
            line=row + 1,
            subject="hidden",
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
    t_ns: NDArray[np.int64],
    lines: NDArray[np.int64],
    names: Sequence[str],
    pos: FloatArray,
    report: ReportBuilder,
    device: dict[str, str],
    options: MarkerOptions,
    more: Sequence[tuple[ChannelSpec, pl.DataFrame]] = (),
) -> Import:
    """Return the import of a capture of markers (m), of channels ``more`` at the same times, and of its angles.

    Shapes: ``t_ns`` and ``lines`` (n,), ``pos`` (n, markers, 3).
    """
    note_hidden(names, pos, report)
    table = marker_table(names, pos)
    spec = ChannelSpec(MARKERS_TOPIC, MARKERS, "optical", tuple(table.columns))
    tables = [(spec, table), *more, *angle_channels(t_ns, names, pos, report, options)]
    blocks = blocks_of([(t_ns, lines, [(s.topic, t) for s, t in tables])], report)
    turning = [s.topic for s, _ in tables if s.schema == ORIENTATION]
    return Import(
        channels=[s for s, _ in tables],
        blocks=rotations(unseen(blocks, report), turning, report),
        report=report,
        metadata={"device": {"clock": "device", "frames": "as the capture system has them", **device}},
    )


def angle_channels(
    t_ns: NDArray[np.int64],
    names: Sequence[str],
    pos: FloatArray,
    report: ReportBuilder,
    options: MarkerOptions,
) -> list[tuple[ChannelSpec, pl.DataFrame]]:
    """Return ``/reference/optical/joint`` and ``…/<segment>/orientation`` as far as the markers say them.

    Shapes: ``t_ns`` (n,), ``pos`` (n, markers, 3) in m.
    """
    if options.angles == "off":
        return []
    roles = {}
    for pair in (options.landmarks or "").replace(" ", "").split(","):
        marker, colon, role = pair.partition(":")
        if pair and not colon:
            raise UsageError(
                f"option landmarks: {pair!r} is no MARKER:LANDMARK pair, such as RLE:right_knee_lat"
            )
        if pair:
            roles[marker] = role
    seen = np.where((pos == 0).all(axis=2, keepdims=True), np.nan, pos)
    try:
        angles = from_markers(t_ns.astype(np.float64) * 1e-9, names, seen, options.angles, roles)
    except ValueError as error:
        raise UsageError(f"option landmarks: {error}") from None
    for doubt in angles.doubts:
        report.note("reference_doubt", doubt, subject=doubt)
    if options.side is not None:
        start = f"{options.side}_"
        angles = ReferenceAngles(
            angle={name.removeprefix(start): v for name, v in angles.angle.items()},
            rot={name.removeprefix(start): v for name, v in angles.rot.items()},
            remarks={name.removeprefix(start): v for name, v in angles.remarks.items()},
        )
    return reference_channels(angles, report)


def reference_channels(
    angles: ReferenceAngles, report: ReportBuilder
) -> list[tuple[ChannelSpec, pl.DataFrame]]:
    """Return the channels of reference angles and attitudes, and say by which definition they are."""
    from scipy.spatial.transform import Rotation

    channels = []
    if angles.angle:
        table = pl.DataFrame(angles.angle)
        metadata = {"sign": "upper - lower segment", **angles.remarks}
        channels.append((ChannelSpec(ANGLES_TOPIC, JOINTS, "", tuple(table.columns), metadata), table))
        for name, loss in angles.remarks.items():
            lost = 100.0 * float(np.mean(~np.isfinite(angles.angle[name])))
            report.note(
                "reference_angle",
                f"{ANGLES_TOPIC} {name}: {loss}; {lost:.2g} % of the frames without",
                subject=name,
            )
    for segment, rot in angles.rot.items():
        quat = np.full((len(rot), 4), np.nan)
        good = np.isfinite(rot).all(axis=(1, 2))
        if good.any():
            quat[good] = Rotation.from_matrix(rot[good]).as_quat(canonical=True, scalar_first=True)
        table = pl.DataFrame({c: quat[:, k] for k, c in enumerate(QUAT)})
        loss = {"frame": "x right, y forward, z up along the segment, from landmarks (docs/joints.md)"}
        channels.append(
            (
                ChannelSpec(f"/reference/optical/{segment}/orientation", ORIENTATION, "optical", QUAT, loss),
                table,
            )
        )
    return channels
