"""Annotating in the native Rerun viewer: ranges and the cursor come from its time panel, keys from the terminal."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from ...recording.errors import MarchaError
from .. import viewer
from ..timeaxis import SINCE_START, UTC, TimeAxis
from .keys import Keys
from .session import Edit, Session, ended_by_keyboard

if TYPE_CHECKING:
    import rerun as rr

    from ..viewer import Viewer

HELP = (
    "Enter   mark the range that is dragged on the viewer's time ruler; without one, the instant of the cursor",
    "i       mark the instant of the cursor",
    "b, e    begin a stretch at the cursor; end and mark it",
    "1 … 9   mark with a label of the tier, by its place in the list",
    "l, t    type the label, the tier, of this and the next marks",
    "u, r    undo, redo",
    "s       save",
    "v       list labels of the tier, and the newest marks",
    "q       leave; what is not saved stays in the draft",
)


class TimePanel(NamedTuple):
    """What the viewer's time panel says, in ns of the recording's clock.

    Attributes
    ----------
    cursor_ns : int or None
        Where the cursor stands.
    range_ns : (int, int) or None
        What is selected on the ruler.
    """

    cursor_ns: int | None
    range_ns: tuple[int, int] | None


def read_time_panel(client: Any, axis: TimeAxis) -> TimePanel:
    """Ask a running viewer for its cursor and the range that is selected on its ruler.

    The only place that reads them from Rerun's experimental ``ViewerClient``.

    Parameters
    ----------
    client : rerun.experimental.ViewerClient
        Connected to the viewer.
    axis : TimeAxis
        Of the recording that it shows.

    Raises
    ------
    MarchaError
        The viewer went away, or answers otherwise than Rerun 0.41 does.
    """
    try:
        shown = client.get_state().recordings[0]
        panel = client.get_blueprint(of="recording").blueprint.get("/time_panel", {})
    except (RuntimeError, ConnectionError, IndexError, AttributeError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise MarchaError(f"the viewer does not say its time: {reason}; is its window closed?") from None
    zero = {SINCE_START: axis.zero_ns, UTC: 0}.get(shown.current_timeline or "")
    if zero is None:
        raise MarchaError(f"the viewer shows the time line {shown.current_timeline!r}; choose {SINCE_START}")
    cursor = shown.current_time
    properties = panel.get("TimePanelBlueprint", {})
    selected = properties.get("time_selection") if properties.get("loop_mode") == "Selection" else None
    return TimePanel(
        None if cursor is None else zero + int(cursor),
        None if selected is None else (zero + int(selected["min"]), zero + int(selected["max"])),
    )


class KeyMarking:
    """Marks by single keys.

    Parameters
    ----------
    session : Session
        What is edited.
    panel : callable
        Returns the viewer's time panel.
    drawn : callable
        Is given every edit, to show it.
    ask : callable
        Is given a prompt and returns the line that was typed.
    say : callable
        Is given a line for the user.
    tier, label : str
        Of marks until others are typed.
    """

    def __init__(
        self,
        session: Session,
        panel: Callable[[], TimePanel],
        drawn: Callable[[Edit], object],
        ask: Callable[[str], str],
        say: Callable[[str], object],
        *,
        tier: str = "manual",
        label: str = "mark",
    ) -> None:
        self.session, self.panel, self.drawn, self.ask, self.say = session, panel, drawn, ask, say
        self.tier, self.label = tier, label
        self.begun: int | None = None
        first, last = session.rec.data_span or (0, 0)
        self._first, self._last = first, last

    def press(self, key: str) -> bool:
        """Do what a key asks for; return whether to go on. What does not fit is said in one line."""
        try:
            return self._press(key)
        except MarchaError as error:
            self.say(" ".join(str(error).split()))
            return True

    def _press(self, key: str) -> bool:
        if key in ("\n", "\r", " "):
            panel = self.panel()
            self._mark(*(panel.range_ns or (panel.cursor_ns, panel.cursor_ns)))
        elif key == "i":
            cursor = self.panel().cursor_ns
            self._mark(cursor, cursor)
        elif key == "b":
            self.begun = self.panel().cursor_ns
            self.say(f"a stretch begins at {self._seconds(self.begun)}; e ends it")
        elif key == "e":
            if self.begun is None:
                self.say("no stretch was begun; b begins one at the cursor")
            else:
                begun, self.begun = self.begun, None
                self._mark(begun, self.panel().cursor_ns)
        elif key.isdigit() and key != "0":
            self._numbered(int(key))
        elif key == "l":
            self.label = self.ask("label: ") or self.label
            self._press("\n")
        elif key == "t":
            self.tier = self.ask("tier: ") or self.tier
            self.say(f"marks go to tier {self.tier}")
        elif key == "u":
            self._back(self.session.undo(), "undo")
        elif key == "r":
            self._back(self.session.redo(), "redo")
        elif key == "s":
            self._save()
        elif key == "v":
            self._list()
        elif key == "q":
            return False
        else:
            self.say("keys:")
            for line in HELP:
                self.say(f"  {line}")
        return True

    def labels(self) -> list[str]:
        """Return the labels of the tier: of its vocabulary, then others that it has."""
        from ...recording.events import vocabularies

        vocabulary = vocabularies(self.session.rec.metadata).get(self.tier)
        labels = list(vocabulary.labels) if vocabulary is not None else []
        if vocabulary is None or not vocabulary.closed:
            labels += sorted({r["label"] for r in self.session.rows.values() if r["tier"] == self.tier})
        return list(dict.fromkeys(labels))

    def _numbered(self, place: int) -> None:
        labels = self.labels()
        if place > len(labels):
            self.say(f"tier {self.tier} has {len(labels)} labels; l types one")
            return
        self.label = labels[place - 1]
        self._press("\n")

    def _mark(self, start: int | None, end: int | None) -> None:
        if start is None or end is None:
            self.say("the viewer has no cursor yet; click on its time panel")
            return
        # the ruler goes on a little over both ends of the recording
        start, end = (min(max(t, self._first), self._last) for t in sorted((start, end)))
        same = {"tier": self.tier, "label": self.label, "start_ns": start, "end_ns": end}
        if any(same.items() <= row.items() for row in self.session.rows.values()):
            self.say(f"{self._words(same)}: is marked already; drag another range")
            return
        done = self.session.edit([same])
        self.drawn(done)
        self.say(f"marked {self._words(done.added[0])}")

    def _back(self, done: Edit, what: str) -> None:
        if not (done.added or done.removed):
            self.say(f"nothing to {what}")
            return
        self.drawn(done)
        parts = [f"+ {self._words(r)}" for r in done.added] + [f"- {self._words(r)}" for r in done.removed]
        self.say(f"{what}: {'; '.join(parts)}")

    def _save(self) -> None:
        entry = self.session.save()
        self.say("nothing to save" if entry is None else f"saved {self.session.out}: change {entry.number}")

    def _list(self) -> None:
        for place, label in enumerate(self.labels()[:9], 1):
            self.say(f"  {place} {label}")
        for row in list(self.session.rows.values())[-5:]:
            self.say(f"  {self._words(row)}")

    def _words(self, row: dict[str, Any]) -> str:
        start, end = self._seconds(row["start_ns"]), self._seconds(row["end_ns"])
        return f"{row['tier']}: {row['label']!r} {start if start == end else f'{start} to {end}'}"

    def _seconds(self, t_ns: int | None) -> str:
        return "nowhere" if t_ns is None else f"{(t_ns - (self.session.rec.start_ns or 0)) / 1e9:.3f} s"


def annotate_in_viewer(
    session: Session,
    *,
    online: bool = False,
    say: Callable[[str], object] = print,
    opened: Callable[[Viewer], object] | None = None,
) -> bool:
    """Open the native viewer and mark in it until its window is closed or ``q`` is pressed.

    Parameters
    ----------
    session : Session
        What is edited; what is not saved at the end stays in its draft.
    online : bool
        Whether the viewer may reach other hosts.
    say : callable
        Is given every line for the user.
    opened : callable, optional
        Called with the viewer once it shows the recording.

    Returns
    -------
    bool
        Whether Ctrl-C ended it; SIGTERM is raised.

    Raises
    ------
    UsageError
        No display on this machine.
    MarchaError
        The viewer did not start, or did not load the recording.
    """
    import rerun as rr

    from ..stream import new_stream, release

    with viewer.native(online=online) as window:
        stream = new_stream()
        stream.set_sinks(rr.GrpcSink(viewer.uri(window.port)))
        try:
            return ended_by_keyboard(_mark, session, stream, window, say, opened)
        except RuntimeError:  # Rerun's thread towards the viewer is gone
            if window.running:
                raise
        finally:
            del stream
            release()
    return False


def _mark(
    session: Session,
    stream: rr.RecordingStream,
    window: Viewer,
    say: Callable[[str], object],
    opened: Callable[[Viewer], object] | None,
) -> None:
    """Draw the recording and let the user mark in it, to the end of the viewer or the user's wish."""
    from rerun.experimental import ViewerClient

    from ..draw import draw
    from ..screenshot import PATIENCE_S, loaded
    from ..stream import finish

    (scene,) = draw([session.rec], stream, annotating=True)

    def shown(done: Edit) -> None:
        scene.lanes.update(done.added, done.removed)
        stream.flush()

    stored = {row["id"]: row for row in session.rec.annotations.to_dicts()}
    changed = tuple(row for name, row in session.rows.items() if stored.get(name) != row)
    shown(Edit(changed, tuple(row for name, row in stored.items() if session.rows.get(name) != row)))
    client = ViewerClient.connect(viewer.uri(window.port))
    loaded(client, session.rec.path, PATIENCE_S)
    if opened is not None:
        opened(window)
    for line in HELP:
        say(line)
    with Keys(say) as keys:
        axis = scene.canvas.axis
        marker = KeyMarking(session, lambda: read_time_panel(client, axis), shown, keys.line, say)
        while window.running:
            key = keys.next()
            if key is not None and not marker.press(key):
                break
    if window.running:
        finish(stream)
