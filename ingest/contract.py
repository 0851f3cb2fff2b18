"""What an importer is: it recognises a raw log by its content and streams it as channels, with a report.

An importer never writes files and never asks. It hands over tables in SI units, time stamps in int64
nanoseconds that never decrease within a channel, and a report in which every row of the source is either kept
or dropped for a named reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol, runtime_checkable

import msgspec
import polars as pl

from ..recording.errors import Finding, MarchaError

#: Bytes of a file that :meth:`Importer.sniff` is shown.
HEAD_BYTES = 65536


class CommonOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options that every importer takes; an importer's ``Options`` inherits from it.

    ``convert`` acts on these fields itself; an importer needs not look at them.
    """

    epoch: Annotated[
        str | None,
        msgspec.Meta(description="UTC time (ISO 8601) of the device clock's zero; makes the clock UTC"),
    ] = None
    start: Annotated[
        str | None, msgspec.Meta(description="UTC time (ISO 8601) of the first sample; makes the clock UTC")
    ] = None
    unpack_limit_gb: Annotated[
        Annotated[float, msgspec.Meta(gt=0)],
        msgspec.Meta(description="most that a zip archive may unpack to, GB"),
    ] = 2.0
    keep_source: Annotated[bool, msgspec.Meta(description="attach the raw source files to the recording")] = (
        False
    )


class ChannelSpec(msgspec.Struct, frozen=True):
    """One channel that an import will deliver.

    Attributes
    ----------
    topic : str
        ``/<device>/<sensor>``, for example ``/foot/imu1``.
    schema : str
        Message type, a key of :data:`marcha.recording.SCHEMAS`.
    frame_id : str
        Name of the frame in which vectors are given.
    columns : tuple of str
        Columns beside ``t_ns``; needed only where the schema's columns are named by the data (joints).
    metadata : dict of str to str
        Device configuration of this channel: full scales, rate, mounting …
    """

    topic: str
    schema: str
    frame_id: str = ""
    columns: tuple[str, ...] = ()
    metadata: dict[str, str] = {}


class SourceAttachment(msgspec.Struct, frozen=True):
    """Something to attach to the recording.

    Attributes
    ----------
    name, media_type : str
        File name and media type.
    data : bytes
        Content.
    """

    name: str
    data: bytes
    media_type: str


class Report(msgspec.Struct, frozen=True):
    """What became of the rows of a source.

    Attributes
    ----------
    rows_read : int
        Rows of the source that should hold data: ``rows_kept + rows_dropped``.
    rows_kept : int
        Rows that became messages, repaired ones included.
    rows_repaired : int
        Kept rows of which something was changed (time, missing cells).
    rows_dropped : int
        Rows that became nothing.
    findings : list of Finding
        Why, and what else the user should know.
    lossy : bool
        Whether data was lost or repaired in a way that the user should know (exit code 3): rows were dropped
        or repaired, or the sensor itself lost data (clipping, long gaps).
    """

    rows_read: int
    rows_kept: int
    rows_repaired: int
    rows_dropped: int
    findings: list[Finding]
    lossy: bool


class ReportBuilder:
    """Counts rows and merges findings while an import streams.

    Findings of one kind and subject are one entry: counts add up, the first line and its detail stay.
    """

    def __init__(self) -> None:
        self.kept = 0
        self.repaired = 0
        self.dropped = 0
        self._lost = False
        self._strict: Path | None = None
        self._findings: dict[tuple[str, str], Finding] = {}

    def refuse_changes(self, source: Path) -> None:
        """Raise at the first row of ``source`` that is dropped or repaired, also where that has happened."""
        self._strict = source
        if self.dropped or self.repaired:
            first = self.build().findings[0]
            self._refuse(first.kind, first.detail, first.first_line)

    def _refuse(self, kind: str, detail: str, line: int | None) -> None:
        if self._strict is not None:
            where = "" if line is None else f", line {line}"
            raise MarchaError(f"{self._strict}{where}: {kind}: {detail}; leave out --strict to accept that")

    def keep(self, rows: int) -> None:
        """Count ``rows`` that became messages."""
        self.kept += int(rows)

    def drop(
        self,
        kind: str,
        detail: str,
        *,
        count: int = 1,
        rows: int | None = None,
        line: int | None = None,
        subject: str = "",
    ) -> None:
        """Count ``rows`` (default ``count``) that become nothing, and say why."""
        self.dropped += int(count if rows is None else rows)
        if count:
            self._refuse(kind, detail, line)
        self.note(kind, detail, count=count, line=line, subject=subject)

    def repair(
        self,
        kind: str,
        detail: str,
        *,
        count: int = 1,
        rows: int | None = None,
        line: int | None = None,
        subject: str = "",
    ) -> None:
        """Say what was changed; ``rows`` (default ``count``) of the kept rows were touched."""
        self.repaired += int(count if rows is None else rows)
        if count:
            self._refuse(kind, detail, line)
        self.note(kind, detail, count=count, line=line, subject=subject)

    def loss(
        self, kind: str, detail: str, *, count: int = 1, line: int | None = None, subject: str = ""
    ) -> None:
        """Say that the source itself lost data here (clipping, a long gap); the rows stay as they are."""
        self._lost = self._lost or count > 0
        self.note(kind, detail, count=count, line=line, subject=subject)

    def note(
        self, kind: str, detail: str, *, count: int = 1, line: int | None = None, subject: str = ""
    ) -> None:
        """Say something about rows that stay as they are."""
        if not count:
            return
        old = self._findings.get((kind, subject))
        line = None if line is None else int(line)
        if old is None:
            self._findings[kind, subject] = Finding(kind, int(count), line, detail)
            return
        earlier = line is not None and (old.first_line is None or line < old.first_line)
        self._findings[kind, subject] = Finding(
            kind,
            old.count + int(count),
            line if earlier else old.first_line,
            detail if earlier else old.detail,
        )

    def build(self) -> Report:
        """Return the report, findings ordered by kind and first line."""
        findings = sorted(
            self._findings.values(), key=lambda f: (f.kind, -1 if f.first_line is None else f.first_line)
        )
        return Report(
            rows_read=self.kept + self.dropped,
            rows_kept=self.kept,
            rows_repaired=min(self.repaired, self.kept),
            rows_dropped=self.dropped,
            findings=findings,
            lossy=bool(self._lost or self.repaired or self.dropped),
        )


class Import:
    """One source being read: declared channels, a stream of tables, and what is known once it has ended.

    Parameters
    ----------
    channels : sequence of ChannelSpec
        All channels that the stream may deliver. A declared channel may stay empty.
    blocks : iterable of (str, polars.DataFrame)
        Topic and table (``t_ns`` Int64 first, then the schema's columns) of some thousand rows each, read
        lazily, so that memory stays bounded. Time never decreases within a topic.
    report : ReportBuilder
        Filled while the blocks are read.
    metadata : dict of str to dict of str to str
        Metadata records, above all ``device`` (with ``clock``: ``device``, ``utc`` or ``unix``). May be
        completed while the blocks are read.
    attachments : list of SourceAttachment
        Same rule.
    also_read : sequence of Path
        Files beside the sources that are read with them (a table of footprints, of anchors).
    annotations : polars.DataFrame, optional
        Annotations on the source's clock, in the columns of :data:`marcha.recording.annotations.COLUMNS`. May be
        set while the blocks are read.
    """

    def __init__(
        self,
        *,
        channels: Sequence[ChannelSpec],
        blocks: Iterable[tuple[str, pl.DataFrame]],
        report: ReportBuilder,
        metadata: dict[str, dict[str, str]] | None = None,
        attachments: list[SourceAttachment] | None = None,
        also_read: Sequence[Path] = (),
        annotations: pl.DataFrame | None = None,
    ) -> None:
        self.annotations = annotations
        self.channels = tuple(channels)
        self.metadata = metadata if metadata is not None else {}
        self.attachments = attachments if attachments is not None else []
        self.also_read = tuple(also_read)
        self._blocks = blocks
        self._builder = report
        self._done = False

    def blocks(self) -> Iterator[tuple[str, pl.DataFrame]]:
        """Yield (topic, table) until the source ends; can be read once."""
        yield from self._blocks
        self._blocks = ()
        self._done = True

    def refuse_changes(self, source: Path) -> None:
        """Make the blocks raise at the first row that is dropped or repaired (``--strict``)."""
        self._builder.refuse_changes(source)

    @property
    def report(self) -> Report:
        """The finished report.

        Raises
        ------
        RuntimeError
            Before the blocks have been exhausted: it would be incomplete.
        """
        if not self._done:
            raise RuntimeError("the report is complete only after all blocks have been read")
        return self._builder.build()


@runtime_checkable
class Importer(Protocol):
    """One raw format. A module a format, registered as an entry point ``marcha.importers``.

    Attributes
    ----------
    name : str
        What users type after ``--format``.
    title : str
        One line for ``marcha formats``.
    Options : type of CommonOptions
        Options of this format, each with a description; its docstring is shown by ``marcha formats``.
    joins : bool
        Whether several inputs given together are pieces of one recording, in the order given. Optional; false
        where it is missing.
    beside : bool
        Whether several inputs given together stand beside each other in one recording, each with its own
        clock. Optional; false where it is missing.
    folders : bool
        Whether a folder or archive can be one recording although ``sniff`` does not know it. Optional; false
        where it is missing.
    floors : bool
        Whether its folders hold the anchor table and the plan as well (:mod:`.floor`). Optional; false where it is
        missing.
    chief : callable
        ``chief(path) -> Path``: the file or folder that stands for the recording of several files that ``path`` is
        one of. Optional; each file is a recording of its own where it is missing.
    """

    name: ClassVar[str]
    title: ClassVar[str]

    @property
    def Options(self) -> type[CommonOptions]:  # noqa: D102 - a class attribute, described above
        ...

    def sniff(self, head: bytes, path: Path) -> float:
        """Tell how surely this is the format, from content.

        Parameters
        ----------
        head : bytes
            The first 64 KiB of a file; empty for a folder.
        path : Path
            The file or folder itself.

        Returns
        -------
        float
            0 no … 1 certain.
        """
        ...

    def read(self, paths: Sequence[Path], options: Any) -> Import:
        """Open the source and declare its channels; rows are read by the blocks.

        Raises
        ------
        MarchaError
            Where the source cannot be read as this format; one line with file, line, rule, value, remedy.
        """
        ...
