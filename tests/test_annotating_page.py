"""The annotating page in a real browser: by mouse, by keyboard alone, and what stays when it is closed."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording.changes import change
from marcha.recording.events import Vocabulary
from marcha.viz.annotating.server import PageServer
from marcha.viz.annotating.session import Session
from marcha.viz.annotating.video import video_of

from .page_helpers import chromium, opened, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

S = 10**9
START_NS = 1_700_000_000_123_456_789
ROWS = 60_001
"""Ten minutes at 100 Hz."""
STEP_NS = 10**7
LEFT = 64
"""Width of the scale beside the signals, pixels."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


@pytest.fixture
def path(tmp_path: Path) -> Path:
    t = START_NS + np.arange(ROWS) * STEP_NS
    phase = 2 * np.pi * np.arange(ROWS) / 100
    imu = {
        f"{kind}_{a}": np.sin(phase + k) + i
        for i, kind in enumerate(("acc", "gyr"))
        for k, a in enumerate("xyz")
    }
    with mr.create(tmp_path / "walk.mcap") as out:
        out.add_table("/foot/imu", "sensor_msgs/msg/Imu", pl.DataFrame({"t_ns": t, **imu}))
    return tmp_path / "walk.mcap"


@pytest.fixture
def server(path: Path) -> Iterator[PageServer]:
    with PageServer(Session(mr.open(path), path, by="eva", overwrite=True, action="page")) as running:
        yield running


@pytest.fixture
def page(browser: Browser, server: PageServer) -> Iterator[Page]:
    shown = opened(browser, server.address)
    yield shown
    assert not shown.evaluate("window.failed")
    shown.close()


def marks(page: Page) -> list[dict[str, Any]]:
    """Annotations by start as the page has them, once it has no request open."""
    return page.evaluate("marcha.marks.queue.then(() => marcha.marks.sorted())")


def stored(path: Path) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in mr.open(path).annotations.to_dicts()}


class Screen:
    """Where a time is on the screen, by the layout that the page promises: the whole recording with half a per cent
    of margin on both sides at first.
    """

    def __init__(self, page: Page) -> None:
        box = page.locator("#stage").bounding_box()
        assert box is not None
        self.left, self.top, self.height = box["x"] + LEFT, box["y"], box["height"]
        self.span = (ROWS - 1) * STEP_NS
        self.per_pixel = 1.01 * self.span / (box["width"] - LEFT)

    def x(self, t_s: float) -> float:
        return self.left + (t_s * S + 0.005 * self.span) / self.per_pixel

    def t(self, x: float) -> float:
        return (x - self.left) * self.per_pixel - 0.005 * self.span


def drag(page: Page, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move((start[0] + end[0]) / 2, end[1], steps=3)
    page.mouse.move(*end)
    page.mouse.up()


def test_a_stretch_is_where_the_mouse_was_to_one_sample(page: Page) -> None:
    screen = Screen(page)
    y = screen.top + 400
    a, b = round(screen.x(100)), round(screen.x(250))
    drag(page, (a, y), (b, y))
    (row,) = marks(page)
    assert abs(row["start_ns"] - screen.t(a)) <= STEP_NS
    assert abs(row["end_ns"] - screen.t(b)) <= STEP_NS
    # and zoomed in, from right to left, over the end of the recording
    page.evaluate("(marcha.view.start = 590e9, marcha.view.end = 610e9, marcha.stage.dirty = true)")
    until(page, "!marcha.stage.dirty")
    width = page.evaluate("marcha.view.width")
    drag(page, (screen.left + width * 0.75, y), (screen.left + width * 0.25, y))
    _, row = marks(page)
    assert abs(row["start_ns"] - 595e9) <= STEP_NS
    assert row["end_ns"] == (ROWS - 1) * STEP_NS


def test_edges_and_whole_annotations_are_dragged_and_undone(page: Page) -> None:
    screen = Screen(page)
    middle, lane = screen.top + 400, screen.top + 6 + 8
    drag(page, (screen.x(100), middle), (screen.x(200), middle))
    (first,) = marks(page)
    drag(page, (screen.x(200), middle), (screen.x(300), middle))  # the selected one's end, over the signals
    (longer,) = marks(page)
    assert longer["start_ns"] == first["start_ns"]
    assert abs(longer["end_ns"] - 300 * S) < 2 * screen.per_pixel
    drag(page, (screen.x(100), lane), (screen.x(150), lane))  # its start, in the lane
    (shorter,) = marks(page)
    assert abs(shorter["start_ns"] - 150 * S) < 2 * screen.per_pixel
    assert shorter["end_ns"] == longer["end_ns"]
    drag(page, (screen.x(220), lane), (screen.x(320), lane))  # all of it
    (moved,) = marks(page)
    assert moved["end_ns"] - moved["start_ns"] == shorter["end_ns"] - shorter["start_ns"]
    assert abs(moved["start_ns"] - 250 * S) < 2 * screen.per_pixel
    for expected in (shorter, longer, first):
        page.locator("#undo").click()
        assert marks(page) == [expected]
    page.locator("#undo").click()
    assert marks(page) == []


def test_overlaps_and_instants_have_their_own_places(page: Page) -> None:
    screen = Screen(page)
    y = screen.top + 500
    drag(page, (screen.x(100), y), (screen.x(300), y))
    page.mouse.click(screen.x(400), screen.top + 20)  # in the lanes: nothing is selected any more
    drag(page, (screen.x(200), y), (screen.x(350), y))
    page.mouse.dblclick(screen.x(450), y)
    page.locator("#tier").fill("gait")
    page.mouse.dblclick(screen.x(250), y)
    rows = marks(page)
    assert [r["tier"] for r in rows] == ["manual", "manual", "gait", "manual"]
    assert [r["start_ns"] == r["end_ns"] for r in rows] == [False, False, True, True]
    lanes = "marcha.stage.lanes.map(l => [l.tier, l.k, l.level.ids.length])"
    wanted = [["gait", 0, 1], ["manual", 0, 2], ["manual", 1, 1]]
    until(page, f"JSON.stringify({lanes}) === '{json.dumps(wanted, separators=(',', ':'))}'")
    # each is found where it is drawn
    for row in rows:
        lane = next(
            lane
            for lane in page.evaluate("marcha.stage.lanes.map(l => [l.top, l.height, l.level.ids])")
            if row["id"] in lane[2]
        )
        page.mouse.click(
            screen.x((row["start_ns"] + row["end_ns"]) / 2 / S), screen.top + lane[0] + lane[1] / 2
        )
        assert page.evaluate("marcha.selected") == row["id"]


def test_the_whole_by_keyboard_alone(page: Page, path: Path) -> None:
    press = page.keyboard.press
    press("t")
    press("Control+a")
    page.keyboard.type("terrain")
    press("Escape")
    press("l")
    page.keyboard.type("grass")
    press("Enter")
    press("Home")
    for _ in range(4):
        press("Shift+ArrowRight")
    press("m")
    for _ in range(6):
        press("Shift+ArrowRight")
    press("m")
    (first,) = marks(page)
    pixel = page.evaluate("marcha.view.perPixel")
    assert (first["tier"], first["label"], first["source"]) == ("terrain", "grass", "human:eva")
    assert abs(first["start_ns"] - 40 * pixel) <= 10
    assert abs(first["end_ns"] - 100 * pixel) <= 10
    press("Control+c")
    press("End")
    press("ArrowLeft")
    press("i")
    (_, instant) = marks(page)
    assert instant["start_ns"] == instant["end_ns"] == round((ROWS - 1) * STEP_NS - pixel)
    press("Enter")
    page.keyboard.type("gravel")
    press("Enter")
    assert marks(page)[1]["label"] == "gravel"
    for _ in range(20):
        press("PageUp")
    press("p")
    assert page.evaluate("marcha.selected") == first["id"]
    press("Alt+ArrowRight")
    assert page.evaluate("marcha.cursor") == first["start_ns"] + STEP_NS
    press("s")
    assert marks(page)[0]["start_ns"] == first["start_ns"] + STEP_NS
    for _ in range(20):
        press("Shift+ArrowRight")
    press("Control+v")
    pasted = marks(page)[1]
    assert pasted["end_ns"] - pasted["start_ns"] == first["end_ns"] - first["start_ns"]
    press("2")
    assert marks(page)[1]["label"] == "gravel"
    press("Control+z")
    press("Control+z")
    press("Control+y")
    rows = marks(page)
    assert [r["label"] for r in rows] == ["grass", "grass", "gravel"]
    press("p")
    press("Delete")
    assert len(marks(page)) == 2
    press("Control+z")
    assert marks(page) == rows
    press("Control+s")
    until(page, "document.getElementById('saved').textContent === 'all saved'")
    zero = mr.open(path).start_ns
    assert zero is not None
    assert {
        (r["id"], r["label"], r["start_ns"] - zero, r["end_ns"] - zero) for r in stored(path).values()
    } == {(r["id"], r["label"], r["start_ns"], r["end_ns"]) for r in rows}


def test_two_hundred_marks_undone_and_redone_equal_their_table(
    page: Page, path: Path, server: PageServer
) -> None:
    press = page.keyboard.press
    for k in range(200):
        press("Shift+ArrowRight" if k % 3 else "ArrowRight")
        if k % 2:
            press("i")
        else:
            press("m")
            press("ArrowRight")
            press("m")
    rows = marks(page)
    assert len(rows) == 200
    for _ in range(200):
        press("Control+z")
    assert marks(page) == []
    assert page.locator("#undo").is_disabled()
    for _ in range(200):
        press("Control+y")
    assert marks(page) == rows
    press("Control+s")
    until(page, "document.getElementById('saved').textContent === 'all saved'")
    assert stored(path) == server.session.rows
    assert len(stored(path)) == 200


def test_a_closed_window_loses_nothing(browser: Browser, server: PageServer, path: Path) -> None:
    page = opened(browser, server.address)
    page.keyboard.press("i")
    marks(page)
    page.keyboard.press("Control+s")
    until(page, "document.getElementById('saved').textContent === 'all saved'")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("i")
    rows = marks(page)
    page.close()
    assert len(stored(path)) == 1
    again = opened(browser, server.address)
    assert marks(again) == rows
    again.close()
    with PageServer(Session(mr.open(path), path, by="eva", overwrite=True, action="page")) as after:
        third = opened(browser, after.address)
        assert marks(third) == rows
        assert "took up 1 edits" in third.locator("#said").inner_text()
        third.close()


def test_two_windows_show_the_same(browser: Browser, page: Page, server: PageServer) -> None:
    page.keyboard.press("i")
    marks(page)
    other = opened(browser, server.address)
    other.keyboard.press("End")
    other.keyboard.press("i")
    both = marks(other)
    other.close()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("i")
    assert len(marks(page)) == 3
    assert all(row in marks(page) for row in both)


def test_what_does_not_fit_is_said_and_nothing_is_lost(browser: Browser, path: Path) -> None:
    words = Vocabulary(labels={"flat": "", "stairs": ""}, closed=True)
    change(mr.open(path), path, vocabulary={"terrain": words}, overwrite=True)
    with PageServer(Session(mr.open(path), path, overwrite=True, action="page")) as server:
        page = opened(browser, server.address)
        page.locator("#tier").fill("terrain")
        page.keyboard.press("Escape")
        page.keyboard.press("i")
        assert marks(page) == []
        assert "closed vocabulary; it has flat, stairs" in page.locator("#said").inner_text()
        page.keyboard.press("2")  # the label of the next mark
        page.keyboard.press("i")
        (row,) = marks(page)
        assert row["label"] == "stairs"
        field = page.locator("#details input[name=end]")
        for text, words in (("99999", "outside"), ("x", "not a number")):
            field.fill(text)
            field.press("Enter")
            assert marks(page) == [row]
            assert words in page.locator("#said").inner_text()
            page.evaluate("marcha.refresh()")
        field.fill("2.5")
        field.press("Enter")
        assert marks(page)[0]["end_ns"] == 2.5 * S
        page.close()


def test_the_page_asks_no_other_host_and_says_when_it_lacks_its_token(
    browser: Browser, server: PageServer
) -> None:
    asked: list[str] = []
    page = browser.new_page()
    page.on("request", lambda request: asked.append(request.url))
    page.goto(server.address)
    until(page, "window.marcha && [...marcha.channels.values()].every(c => c.complete)")
    assert all(url.startswith((f"http://127.0.0.1:{server.port}/", "data:")) for url in asked)
    page.goto(server.address.partition("?")[0])
    until(page, "document.getElementById('said').textContent.includes('token')")
    assert not page.evaluate("window.marcha !== undefined")
    page.close()


def test_zoomed_in_the_rows_themselves_are_drawn(page: Page) -> None:
    """At every zoom what is drawn has about as many pieces as the screen has pixels, and ends with the rows."""
    drawn = (
        "() => { const c = [...marcha.channels.values()][0];"
        " const p = c.cover(marcha.view);"
        " return [Math.min(...p.map(q => q.rows)), p.reduce((n, q) => n + q.to - q.from + 1, 0)]; }"
    )
    for span in (600, 60, 6, 0.5):
        page.evaluate(
            f"(marcha.view.start = 300e9, marcha.view.end = 300e9 + {span}e9, marcha.stage.dirty = true)"
        )
        until(page, "[...marcha.channels.values()].every(c => c.pending.size === 0) && !marcha.stage.dirty")
        rows, pieces = page.evaluate(drawn)
        assert pieces <= 16 * page.evaluate("marcha.view.width") + 64
        assert rows == 1 if span < 100 else rows >= 16
    picture = page.evaluate(
        "() => { const c = document.getElementById('signals');"
        " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        " let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; }"
    )
    assert picture > 1000


FILM = """async () => {
  if (!window.MediaRecorder) return null;
  const canvas = document.createElement('canvas');
  canvas.width = 160; canvas.height = 90;
  const context = canvas.getContext('2d');
  const parts = [];
  const recorder = new MediaRecorder(canvas.captureStream(25), { mimeType: 'video/webm' });
  recorder.ondataavailable = (event) => parts.push(event.data);
  const ended = new Promise((r) => { recorder.onstop = r; });
  recorder.start();
  const begun = performance.now();
  while (performance.now() - begun < 1500) {
    context.fillStyle = `hsl(${performance.now() / 5}, 80%, 50%)`;
    context.fillRect(0, 0, 160, 90);
    await new Promise((r) => requestAnimationFrame(r));
  }
  recorder.stop();
  await ended;
  const bytes = new Uint8Array(await new Blob(parts).arrayBuffer());
  let text = '';
  for (const b of bytes) text += String.fromCharCode(b);
  return btoa(text);
}"""


def test_the_film_shows_the_moment_of_the_cursor_and_moves_it(browser: Browser, path: Path) -> None:
    maker = browser.new_page()
    film = maker.evaluate(FILM)
    maker.close()
    if not film:
        pytest.skip("this browser records no film")
    path.with_suffix(".webm").write_bytes(base64.b64decode(film))
    rec = mr.open(path)
    found = video_of(rec, offset_s=100.0)
    assert found is not None
    with PageServer(Session(rec, path, overwrite=True, action="page"), found) as server:
        page = opened(browser, server.address)
        until(page, "marcha.film.video.readyState >= 2")
        page.evaluate("marcha.setCursor(100.6e9)")
        until(page, "Math.abs(marcha.film.video.currentTime - 0.6) < 0.01 && !marcha.film.video.seeking")
        page.evaluate("marcha.setCursor(50e9)")  # before it begins: its first picture
        until(page, "marcha.film.video.currentTime === 0 && !marcha.film.video.seeking")
        page.keyboard.press("Space")
        until(page, "marcha.cursor > 100.05e9")
        page.keyboard.press("Space")
        until(page, "marcha.film.video.paused || marcha.film.video.ended")
        seen = page.evaluate("marcha.film.video.currentTime")
        assert abs(page.evaluate("marcha.cursor") - (100 + seen) * 1e9) < 0.2e9
        page.close()


def test_the_list_of_keys_is_shown(page: Page) -> None:
    page.keyboard.press("?")
    text = page.locator("#keys").inner_text()
    assert "begin a stretch" in text
    assert json.loads(page.evaluate("JSON.stringify(document.getElementById('keys').open)"))
    page.keyboard.press("Escape")
    assert not page.evaluate("document.getElementById('keys').open")
