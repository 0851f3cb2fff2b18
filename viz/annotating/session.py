"""Annotating one recording by eye: edits with undo and redo, a draft that outlives the program, saving.

The page and the viewer's terminal both work on a :class:`Session`. Every edit stands in the draft, a file beside
the recording that is to be written, before it is answered: whatever ends the program, the next session on the same
recording takes it up. Saving writes the difference between what the recording holds and what the session holds as
one change (:mod:`marcha.recording.changes`).
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from ...recording import Recording
from ...recording import open as open_recording
from ...recording.annotations import COLUMNS, check_annotations
from ...recording.changes import Change, change, check_inside, check_labels, user
from ...recording.errors import MarchaError, UsageError
from ...recording.events import vocabularies

Row = dict[str, Any]
"""One annotation: the columns of :data:`marcha.recording.annotations.COLUMNS`."""


def ended_by_keyboard(work: Callable[..., object], *args: Any) -> bool:
    """Let the user work by ``work(*args)``, and return whether Ctrl-C ended it.

    Ctrl-C ends a session, SIGTERM the program: its exception, a kind of ``KeyboardInterrupt``, is raised.
    """
    try:
        work(*args)
    except KeyboardInterrupt as ending:
        if type(ending) is not KeyboardInterrupt:
            raise
        return True
    return False


class Edit(msgspec.Struct, frozen=True):
    """Annotations that came and annotations that went, whole: what undoing needs.

    An annotation that was changed is in both, under the same id.
    """

    added: tuple[Row, ...] = ()
    removed: tuple[Row, ...] = ()

    @property
    def reversed(self) -> Edit:
        """The edit that takes this one back."""
        return Edit(self.removed, self.added)


class Session:
    """The annotations of one recording while somebody works on them; safe to use from several threads.

    Parameters
    ----------
    rec : Recording
        What is annotated.
    out : Path
        Where saving writes; the recording's own path to replace it.
    by : str, optional
        Who works; the user's name by default.
    overwrite : bool
        Whether ``out`` may be replaced when first saved.
    action : str
        What the list of changes says of a save.

    Attributes
    ----------
    rows : dict of str to dict
        Annotations by id.
    revision : int
        Grows with every edit.
    taken_up : int
        Edits of an earlier session that were found in its draft.

    Raises
    ------
    UsageError
        ``out`` exists and may not be replaced.
    MarchaError
        The draft of an earlier session does not fit the recording.
    """

    def __init__(
        self, rec: Recording, out: Path, *, by: str | None = None, overwrite: bool = False, action: str
    ) -> None:
        self.rec, self.out, self.by, self.action = rec, out, by or user(), action
        self.draft = out.with_name(f"{out.name}.draft.jsonl")
        if out.exists() and not overwrite:
            raise UsageError(f"{out}: exists; give another name, --force to replace it, or --in-place")
        self._overwrite = overwrite
        self._lock, self._saving = threading.RLock(), threading.Lock()
        self._saved: dict[str, Row] = _by_id(rec)
        self.rows = dict(self._saved)
        self._done: list[Edit] = []
        self._undone: list[Edit] = []
        self.revision = 0
        self.taken_up = self._take_up_draft()

    # ------------------------------------------------------------------------------------------------ editing

    def edit(self, add: Iterable[Mapping[str, Any]] = (), remove: Collection[str] = ()) -> Edit:
        """Add, remove or (an id that is in both) change annotations, all at once or not at all.

        Parameters
        ----------
        add : iterable of mapping
            Annotations; without an id they get one. Those without a source, and those that are changed, are the
            user's: a stance whose end was moved by hand is no longer what the algorithm said.
        remove : collection of str
            Ids.

        Raises
        ------
        MarchaError
            As :func:`marcha.recording.changes.change` has it: outside of the recording, reversed, an id that is
            taken, a label that a closed vocabulary does not have.
        """
        with self._lock:
            mine = f"human:{self.by}"
            rows = [{**row, "source": row.get("source") or mine} for row in add]
            for row in rows:
                before = self.rows.get(row.get("id") or "")
                if before is not None and any(
                    before[k] != row.get(k) for k in ("start_ns", "end_ns", "label")
                ):
                    row["source"] = mine
            done = self._prepared(rows, remove)
            if done.added or done.removed:
                self._note(done)
                self._apply(done)
                self._done.append(done)
                self._undone.clear()
            return done

    def undo(self) -> Edit:
        """Take the last edit back; an empty one where there is none."""
        return self._back(self._done, self._undone)

    def redo(self) -> Edit:
        """Do again what was undone last; an empty one where there is none."""
        return self._back(self._undone, self._done)

    def _back(self, source: list[Edit], target: list[Edit]) -> Edit:
        with self._lock:
            if not source:
                return Edit()
            back = source[-1].reversed
            self._note(back)
            self._apply(back)
            source.pop()
            target.append(back)
            return back

    def _prepared(self, add: Iterable[Mapping[str, Any]], remove: Collection[str]) -> Edit:
        gone = dict.fromkeys(remove)
        for name in gone:
            if name not in self.rows:
                raise MarchaError(f"{self.rec.path}: there is no annotation {name!r} any more; look again")
        rows = [
            {
                **row,
                "id": row.get("id") or self._new_id(),
                "metadata": row.get("metadata") or "{}",
            }
            for row in add
        ]
        try:
            table = check_annotations(pl.DataFrame(rows, schema=COLUMNS, orient="row"))
        except (TypeError, pl.exceptions.PolarsError) as error:
            reason = " ".join(str(error).split())
            raise MarchaError(f"{self.rec.path}: that is no annotation: {reason}") from None
        check_inside(self.rec, table)
        check_labels(self.rec.path, table, vocabularies(self.rec.metadata))
        for name in table["id"]:
            if name in self.rows and name not in gone:
                raise MarchaError(f"{self.rec.path}: annotation id {name!r} is taken; give another")
        return Edit(tuple(table.select(*COLUMNS).to_dicts()), tuple(self.rows[name] for name in gone))

    def _new_id(self) -> str:
        while (name := secrets.token_hex(6)) in self.rows:
            pass
        return name

    def _apply(self, done: Edit) -> None:
        for row in done.removed:
            self.rows.pop(row["id"], None)
        self.rows.update((row["id"], row) for row in done.added)
        self.revision += 1

    @property
    def can_undo(self) -> bool:
        """Whether there is an edit to take back."""
        return bool(self._done)

    @property
    def can_redo(self) -> bool:
        """Whether there is an edit to do again."""
        return bool(self._undone)

    # ------------------------------------------------------------------------------------------------- saving

    @property
    def unsaved(self) -> int:
        """How many annotations differ from what the recording holds."""
        with self._lock:
            ids = self.rows.keys() | self._saved.keys()
            return sum(self.rows.get(name) != self._saved.get(name) for name in ids)

    def save(self) -> Change | None:
        """Write what the session changed; None where nothing differs from the recording.

        The recording is read again first: what another program added meanwhile stays. Editing goes on while the
        file is written.

        Raises
        ------
        MarchaError
            The file cannot be written, or another program removed what was changed here; the draft stays.
        """
        with self._saving:
            with self._lock:
                asked = dict(self.rows)
                gone = [name for name, row in self._saved.items() if asked.get(name) != row]
                came = [row for name, row in asked.items() if self._saved.get(name) != row]
            if not gone and not came:
                return None
            entry = change(
                open_recording(self.rec.path),
                self.out,
                add=pl.DataFrame(came, schema=COLUMNS, orient="row"),
                remove=gone,
                action=self.action,
                by=self.by,
                overwrite=self._overwrite,
            )
            with self._lock:
                self._reopen(asked)
            return entry

    def _reopen(self, asked: Mapping[str, Row]) -> None:
        """Take the file that was written as what is saved, with the edits since ``asked`` on top of it."""
        self._overwrite = True
        self.rec = open_recording(self.out)
        self._saved = _by_id(self.rec)
        since = {name: row for name, row in self.rows.items() if asked.get(name) != row}
        rows = {name: row for name, row in self._saved.items() if name not in asked or name in self.rows}
        if rows.keys() | since.keys() != self.rows.keys():
            self.revision += 1  # another program added something
        self.rows = rows | since
        self.draft.unlink(missing_ok=True)
        if self.unsaved:
            added = [row for name, row in self.rows.items() if self._saved.get(name) != row]
            removed = [row for name, row in self._saved.items() if self.rows.get(name) != row]
            self._note(Edit(tuple(added), tuple(removed)))

    # -------------------------------------------------------------------------------------------------- draft

    def _note(self, done: Edit) -> None:
        """Append an edit to the draft."""
        try:
            with self.draft.open("ab") as file:
                file.write(msgspec.json.encode(done) + b"\n")
        except OSError as error:
            raise MarchaError(
                f"{self.draft}: {error.strerror or error}; the edit was not made: nothing would keep it"
            ) from None

    def _take_up_draft(self) -> int:
        """Do the edits of an earlier session again; a last line that was cut short is left out."""
        if not self.draft.exists():
            return 0
        data = self.draft.read_bytes()
        lines = data[: data.rfind(b"\n") + 1].splitlines()
        for number, line in enumerate(lines, 1):
            try:
                edit = msgspec.json.decode(line, type=Edit)
                done = self._prepared(edit.added, [row["id"] for row in edit.removed])
            except (msgspec.MsgspecError, MarchaError, KeyError) as error:
                raise MarchaError(
                    f"{self.draft}: line {number}: the draft of an earlier session does not fit the recording "
                    f"({error}); move that file away to begin anew"
                ) from None
            self._apply(done)
            self._done.append(done)
        return len(lines)


def _by_id(rec: Recording) -> dict[str, Row]:
    return {row["id"]: row for row in rec.annotations.select(*COLUMNS).to_dicts()}
