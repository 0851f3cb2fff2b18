"""The viewer itself: it shows every tab without a complaint, and listens on this machine only."""

from __future__ import annotations

import io
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import marcha.recording as mr
import marcha.replay as rp
import marcha.viz as viz
import numpy as np
import polars as pl
import psutil
import pytest
from marcha.recording.changes import change
from marcha.recording.errors import MarchaError
from marcha.viz import viewer
from marcha.viz.screenshot import screenshots
from marcha.viz.text import drawn_only

from .test_viz_rrd import RUN, write_walk

ICD = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]
needs_vulkan = pytest.mark.skipif(
    not any(list(folder.glob("*.json")) for folder in ICD) and "VK_DRIVER_FILES" not in os.environ,
    reason="no Vulkan driver (Debian: apt-get install mesa-vulkan-drivers libvulkan1)",
)


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    raw = write_walk(folder / "walk.mcap")
    rp.replay(raw, ["foot.9iez", "foot.naive"], out=folder / "done.mcap")
    return viz.write_rrd(mr.open(folder / "done.mcap"), folder / "done.rrd")


@pytest.mark.vulkan
@needs_vulkan
def test_no_view_complains_and_every_tab_has_a_picture(rrd: Path) -> None:
    from PIL import Image

    tabs = ["Overview", "Raw", "Detector", "Compare", "Report"]
    pictures = screenshots(rrd, tabs, at=0.6)
    assert [p.tab for p in pictures] == tabs
    for picture in pictures:
        assert picture.reports == (), picture.tab
        pixels = np.asarray(Image.open(io.BytesIO(picture.png)).convert("L"), dtype=float)
        assert pixels.shape == (900, 1600)
        assert np.ptp(pixels) > 100, f"{picture.tab} is blank"
        assert pixels.std() > 8, f"{picture.tab} is blank"
    assert len({p.png for p in pictures}) == len(tabs)


@pytest.mark.vulkan
@needs_vulkan
def test_a_tab_that_is_not_there_is_named(rrd: Path) -> None:
    with pytest.raises(MarchaError, match="no tab 'Map'; it has"):
        screenshots(rrd, ["Map"])


@pytest.mark.vulkan
@needs_vulkan
def test_labels_of_every_script_have_a_picture(rrd: Path, tmp_path: Path) -> None:
    """The viewer without a window has one font and ends at what that lacks; pictures have ``?`` there."""
    done = mr.open(rrd.with_name("done.mcap"))
    times = [done.start_ns, done.start_ns + 10**9]
    marks = {"tier": ["歩く", "b"], "label": ["歩行 ä Ω д", "م"], "start_ns": times, "end_ns": times[::-1]}
    change(done, tmp_path / "a.mcap", add=pl.DataFrame(marks).with_columns(start_ns=pl.lit(times[0])))
    with pytest.raises(MarchaError, match=r"did not answer.*glyph"):
        screenshots(viz.write_rrd(mr.open(tmp_path / "a.mcap"), tmp_path / "whole.rrd"))
    with drawn_only():
        viz.write_rrd(mr.open(tmp_path / "a.mcap"), tmp_path / "a.rrd")
    (shot,) = screenshots(tmp_path / "a.rrd")
    assert shot.reports == ()


@pytest.mark.vulkan
@needs_vulkan
def test_a_replay_is_seen_live(rrd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rerun.experimental import ViewerClient

    native = viewer.native
    monkeypatch.setattr(viewer, "native", lambda online: native(headless=True))
    sink = viz.LiveSink(show=True)
    rp.replay(mr.open(rrd.parent / "walk.mcap"), ["foot.9iez"], sinks=[sink])
    (window,) = sink.viewers
    with window:
        client = ViewerClient.connect(viewer.uri(window.port))
        schema = client.get_recording_schema(paths_only=True)
        assert {f"/run/{RUN}/trail", "/foot/imu1/acc", "/report"} <= {e.entity_path for e in schema.entities}
        assert client.get_state().views


def listening(process: psutil.Process) -> set[str]:
    """Return the addresses at which a process or its children listen."""
    family = [process, *process.children(recursive=True)]
    return {c.laddr.ip for p in family for c in p.net_connections("tcp") if c.status == psutil.CONN_LISTEN}


def test_the_web_viewer_serves_this_machine_only_and_ends() -> None:
    with viewer.web(open_browser=False) as window:
        process = psutil.Process(window._process.pid)
        family = [process, *process.children(recursive=True)]
        assert listening(process) == {"127.0.0.1"}
        page = urllib.request.urlopen(window.address, timeout=10).read()
        assert b"<title>" in page
        assert f"{window.port}" in window.address
    assert not window.running
    gone, alive = psutil.wait_procs(family, timeout=10)
    assert not alive, gone


def test_the_page_of_the_web_viewer_may_talk_to_no_other_host() -> None:
    with viewer.web(open_browser=False) as window:
        answer = urllib.request.urlopen(window.address, timeout=10)
        rules = dict(r.strip().split(" ", 1) for r in answer.headers["Content-Security-Policy"].split(";"))
        page = answer.read().decode()
        assert "https://" in page  # Rerun's page asks for fonts and counts visits: that is why
        allowed = {source for sources in rules.values() for source in sources.split()}
        here = {f"http://{name}:{window.port}" for name in ("127.0.0.1", "localhost")}
        assert {source for source in allowed if "//" in source} == here
        assert rules["default-src"] == "'none'"
        wasm = urllib.request.urlopen(window.address.partition("?")[0] + "re_viewer_bg.wasm", timeout=10)
        assert wasm.read(4) == b"\0asm"


def test_a_viewer_is_told_of_no_way_out_unless_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    class Process:
        stdin = None

        def __init__(self, command: list[str], env: dict[str, str], **_: object) -> None:
            seen.append(env)

        def poll(self) -> int:
            return 1

    monkeypatch.setattr(viewer.subprocess, "Popen", Process)
    monkeypatch.delenv("HTTPS_PROXY", raising=False)
    for online in (False, True):
        with pytest.raises(MarchaError):
            viewer.native(headless=True, online=online)
    assert seen[0]["HTTPS_PROXY"] == seen[0]["https_proxy"] == viewer.NOWHERE
    assert "HTTPS_PROXY" not in seen[1]


def started(code: str) -> tuple[subprocess.Popen[str], list[psutil.Process]]:
    """Start a program that opens the web viewer and waits; return it and the processes below it."""
    environment = {**os.environ, "BROWSER": "true"}
    command = [sys.executable, "-c", code]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert program.stdout is not None
    assert program.stdout.readline().startswith("http://127.0.0.1:")
    return program, psutil.Process(program.pid).children(recursive=True)


WAITING = (
    "import sys, marcha.recording as mr, marcha.viz as viz\n"
    "viz.show(mr.open({path!r}), web=True, open_browser=False, "
    "opened=lambda w: print(w.address, flush=True))\n"
)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_nothing_is_left_of_the_web_viewer_when_its_program_is_ended(rrd: Path, name: str) -> None:
    program, family = started(WAITING.format(path=str(rrd.parent / "walk.mcap")))
    assert len(family) >= 2
    program.send_signal(getattr(signal, name))
    program.wait(timeout=5)
    _, alive = psutil.wait_procs(family, timeout=5)
    for process in alive:
        process.kill()
    assert not alive


def test_a_viewer_that_cannot_start_says_why() -> None:
    with socket.socket() as taken:
        taken.bind((viewer.HOST, 0))
        port = taken.getsockname()[1]
        with pytest.raises(MarchaError, match=r"did not start: .*wrong-option"):
            viewer.Viewer([*viewer.RERUN, "--wrong-option"], port)
