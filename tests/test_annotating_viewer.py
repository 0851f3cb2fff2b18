"""Marking in the native viewer: by keys alone without one, and with a real mouse on its time ruler."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import marcha.recording as mr
import pytest
from marcha.recording import MarchaError
from marcha.recording.changes import change
from marcha.recording.events import Vocabulary
from marcha.viz.annotating.session import Edit, Session
from marcha.viz.annotating.viewer import KeyMarking, TimePanel, read_time_panel
from marcha.viz.timeaxis import SINCE_START, UTC, TimeAxis

from .annotation_samples import SPAN_NS, START_NS, recording
from .test_viz_viewer import needs_vulkan

S = 10**9
PACE_S = 0.3
"""A hand is no faster; without graphics hardware the viewer draws a few pictures a second."""
SLOW_S = 0.5
"""A picture takes 0.2 s without graphics hardware; on a machine with other work a drag may be lost."""
RULER = (790, 797, 783, 776, 804, 811)
"""Heights at which the time ruler of a window of 900 pixels is."""

ELSEWHERE = tuple(range(832, 600, -7))
"""Where it may be after a drag that pulled the panel's edge with it."""


class Screen:
    """A viewer that somebody else drags in, and a terminal that somebody else types at."""

    def __init__(self, path: Path) -> None:
        self.cursor: int | None = START_NS + 5 * S
        self.range: tuple[int, int] | None = None
        self.typed: list[str] = []
        self.said: list[str] = []
        self.edits: list[Edit] = []
        self.session = Session(mr.open(path), path, by="eva", overwrite=True, action="viewer")
        self.marker = KeyMarking(
            self.session,
            lambda: TimePanel(self.cursor, self.range),
            self.edits.append,
            lambda prompt: self.typed.pop(0),
            self.said.append,
        )

    def press(self, keys: str) -> None:
        for key in keys:
            assert self.marker.press(key) is (key != "q")

    @property
    def marks(self) -> list[tuple[str, str, float, float]]:
        rows = sorted(self.session.rows.values(), key=lambda r: (r["start_ns"], r["end_ns"]))
        return [
            (r["tier"], r["label"], (r["start_ns"] - START_NS) / S, (r["end_ns"] - START_NS) / S)
            for r in rows
        ]


@pytest.fixture
def screen(tmp_path: Path) -> Screen:
    return Screen(recording(tmp_path / "walk.mcap"))


def test_ranges_instants_stretches_labels_and_tiers(screen: Screen) -> None:
    screen.range = (START_NS + 10 * S, START_NS + 12 * S)
    screen.press("\n")
    screen.press("i")
    screen.typed = ["bad stretch", "terrain", "Gehweg 路"]
    screen.press("l")
    screen.range = None
    screen.press("t")
    screen.cursor = START_NS + 20 * S
    screen.press("b")
    screen.cursor = START_NS + 18 * S
    screen.press("e")
    screen.cursor = START_NS + 30 * S
    screen.press("l")
    assert screen.marks == [
        ("manual", "mark", 5, 5),
        ("manual", "mark", 10, 12),
        ("manual", "bad stretch", 10, 12),
        ("terrain", "bad stretch", 18, 20),
        ("terrain", "Gehweg 路", 30, 30),
    ]
    screen.cursor = START_NS + 40 * S
    screen.press("2")  # labels of the tier, by the alphabet: it has no vocabulary
    assert screen.marks[-1] == ("terrain", "bad stretch", 40, 40)
    assert len(screen.edits) == 6


def test_undo_redo_save_and_leave(screen: Screen) -> None:
    screen.press("i")
    screen.cursor = START_NS + 6 * S
    screen.press("iuur")
    assert len(screen.marks) == 1
    assert "undo: - manual: 'mark' 6.000 s" in screen.said
    screen.press("sq")
    assert screen.said[-1].startswith("saved ")
    assert mr.open(screen.session.out).annotations["start_ns"].to_list() == [START_NS + 5 * S]
    screen.press("suu")
    assert screen.said[-3:] == ["nothing to save", "undo: - manual: 'mark' 5.000 s", "nothing to undo"]


def test_what_does_not_fit_is_one_line_and_marks_nothing(screen: Screen) -> None:
    path = screen.session.out
    change(
        mr.open(path), path, vocabulary={"manual": Vocabulary(labels={"ok": ""}, closed=True)}, overwrite=True
    )
    screen = Screen(path)
    screen.press("i")
    assert "closed vocabulary; it has ok" in screen.said[-1]
    screen.press("2")
    assert screen.said[-1] == "tier manual has 1 labels; l types one"
    screen.press("1")
    assert [m[1] for m in screen.marks] == ["ok"]
    screen.press("1")
    assert "is marked already" in screen.said[-1]
    screen.cursor = None
    screen.press("i")
    assert "has no cursor" in screen.said[-1]
    screen.press("e?")
    assert len(screen.marks) == 1
    screen.range = (START_NS - S, START_NS + 2 * SPAN_NS)  # the ruler goes on over both ends
    screen.press("\n")
    assert screen.marks[0][2:] == (0, SPAN_NS / S)


def test_the_time_panel_is_read_on_both_time_lines_or_says_why_not() -> None:
    class Client:
        def __init__(self, line: str | None, panel: dict[str, Any], recordings: int = 1) -> None:
            shown = type("Recording", (), {"current_timeline": line, "current_time": 7})
            self.state = type("State", (), {"recordings": [shown] * recordings})
            self.panel = panel

        def get_state(self) -> Any:
            return self.state

        def get_blueprint(self, of: str) -> Any:
            return type("Blueprint", (), {"blueprint": {"/time_panel": {"TimePanelBlueprint": self.panel}}})

    axis = TimeAxis(100, utc=True)
    selected = {"loop_mode": "Selection", "time_selection": {"min": 1, "max": 2}}
    assert read_time_panel(Client(SINCE_START, selected), axis) == TimePanel(107, (101, 102))
    assert read_time_panel(Client(UTC, selected), axis) == TimePanel(7, (1, 2))
    assert read_time_panel(Client(SINCE_START, {**selected, "loop_mode": "Off"}), axis) == TimePanel(
        107, None
    )
    with pytest.raises(MarchaError, match="choose since_start"):
        read_time_panel(Client("log_tick", {}), axis)
    with pytest.raises(MarchaError, match="is its window closed"):
        read_time_panel(Client(None, {}, recordings=0), axis)


# ------------------------------------------------------------------------------------------- with a real mouse


@pytest.fixture
def display() -> Iterator[str]:
    if not (shutil.which("Xvfb") and shutil.which("xdotool")):
        pytest.skip("no Xvfb or xdotool for a display without a screen")
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", "1400x900x24", "-nolisten", "tcp"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert server.stdout is not None
    number = server.stdout.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait()


def typed(stream: IO[str], keys: str) -> None:
    stream.write(keys)
    stream.flush()


def heard(stream: IO[str], words: str) -> str:
    """Return the next line of a program that contains words."""
    for line in stream:
        if words in line:
            return line
    raise AssertionError(f"it ended without saying {words!r}")


@needs_vulkan
@pytest.mark.vulkan
def test_a_range_dragged_with_a_real_mouse_is_marked_shown_undone_and_saved(
    tmp_path: Path, display: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rerun.experimental import ViewerClient

    path, out = recording(tmp_path / "walk.mcap"), tmp_path / "marked.mcap"
    monkeypatch.setenv("DISPLAY", display)
    command = [sys.executable, "-c", "import sys; from marcha.cli import main; sys.exit(main(sys.argv[1:]))"]
    program = subprocess.Popen(
        [*command, "annotate", str(path), "--show", "-o", str(out), "--by", "eva"],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert program.stdin is not None
    assert program.stderr is not None
    late = threading.Timer(240.0, program.kill)  # nothing below waits for ever
    late.start()
    try:
        address = heard(program.stderr, "the viewer is at").split()[-1]
        heard(program.stderr, "leave;")
        client = ViewerClient.connect(address)
        marked = _dragged(client, tmp_path / "first.png")
        assert marked is not None, "no drag on the ruler selected a range"
        typed(program.stdin, "\n")
        said = heard(program.stderr, "marked manual: 'mark'")
        assert f"{marked[0] / 1e9:.3f} s to {marked[1] / 1e9:.3f} s" in said
        typed(program.stdin, "lbad stretch\n")
        heard(program.stderr, "marked manual: 'bad stretch'")
        typed(program.stdin, "us")
        heard(program.stderr, "undo: - manual: 'bad stretch'")
        heard(program.stderr, "saved")
        assert [v.name for v in client.get_state().views if v.reports] == []
        typed(program.stdin, "q")
        assert program.wait(timeout=30) == 0
    finally:
        late.cancel()
        program.kill()
        program.wait()
    (row,) = mr.open(out).annotations.to_dicts()
    zero = mr.open(path).start_ns
    assert zero is not None
    assert (row["start_ns"] - zero, row["end_ns"] - zero) == marked
    assert (row["tier"], row["label"], row["source"]) == ("manual", "mark", "human:eva")


def _dragged(client: Any, picture: Path) -> tuple[int, int] | None:
    """Drag along the ruler; return the range that the viewer says is selected then, asked by other means."""

    def mouse(*arguments: object) -> None:
        subprocess.run(["xdotool", *map(str, arguments)], check=True, capture_output=True)
        until, answers = time.monotonic() + PACE_S, 0
        while time.monotonic() < until or answers < 2:  # the second is of a picture begun after the movement
            asked = time.monotonic()
            client.get_state()
            waits.append(time.monotonic() - asked)
            answers += 1

    waits: list[float] = []
    until, rounds = time.monotonic() + 150, 0
    while time.monotonic() < until:
        rounds += 1
        # A drag before the first whole picture may pull the panel's edge away and the ruler with it.
        client.save_screenshot(str(picture))
        for y in RULER if rounds == 1 else (*RULER, *ELSEWHERE):
            if time.monotonic() > until:
                break
            mouse("mousemove", 600, y)
            mouse("mousedown", 1)
            for x in (650, 700, 760, 800):
                mouse("mousemove", x, y)
            mouse("mouseup", 1)
            panel = client.get_blueprint(of="recording").blueprint["/time_panel"]["TimePanelBlueprint"]
            if panel.get("loop_mode") == "Selection":
                return int(panel["time_selection"]["min"]), int(panel["time_selection"]["max"])
    pace = sum(waits) / max(1, len(waits))
    if pace > SLOW_S:
        pytest.skip(f"the viewer draws a picture in {pace:.1f} s here: too slow to drag in")
    return None
