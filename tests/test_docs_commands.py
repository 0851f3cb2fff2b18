"""What the documents tell a reader to type does what they say: commands, their output, and Python."""

from __future__ import annotations

import inspect
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import marcha.recording as mr
import marcha.replay as rp
import marcha.study as study
import marcha.viz as viz
import polars as pl
import pytest
from marcha.cli.app import build
from marcha.ingest.simulate import simulate

from .cli_helpers import marcha
from .conftest import ROOT
from .docs_blocks import PAGES, Block, blocks, commands, squeezed

RUN = [ROOT / "README.md", ROOT / "docs" / "getting-started.md"]
SHELL = [b for page in PAGES for b in blocks(page, "bash")]


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[list[mr.Recording]]:
    """Note what would be shown in a viewer's window, and open none."""
    seen: list[list[mr.Recording]] = []
    monkeypatch.setattr(viz, "show", lambda recs, **_: seen.append(list(recs)))
    return seen


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reader's own log: serial text whose name tells nothing, no truth beside it."""
    folder = tmp_path_factory.mktemp("log")
    raw = simulate("rectangle", folder / "raw", seed=1)
    return Path(shutil.copy(raw.paths[0], folder / "walk.txt"))


@pytest.mark.parametrize("page", RUN, ids=lambda p: p.name)
def test_the_page_can_be_followed_to_its_end(
    page: Path, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: list[Any]
) -> None:
    shutil.copy(log, tmp_path / "walk.txt")
    monkeypatch.chdir(tmp_path)
    said: list[str] = []
    count = 0
    for block in blocks(page):
        if block.language == "bash" and block.runs:
            said = []
            for command in commands(block.text):
                count += 1
                done = marcha(*command.words)
                assert done.code == command.code, f"{block.page}:{block.line}: {command.words}\n{done.err}"
                said += squeezed(done.out) + squeezed(done.err)
        elif block.language == "text":
            for line in (x for x in squeezed(block.text) if x != "…"):
                assert line in said, f"{block.page}:{block.line}: marcha does not say: {line}"
                said = said[said.index(line) + 1 :]
        elif block.language == "python":
            run(block, {})
    assert count >= 7
    assert len(shown) == 1


def run(block: Block, names: dict[str, Any]) -> dict[str, Any]:
    """Run a block of Python; a failure names the page's line."""
    text = "\n" * block.line + block.text
    exec(compile(text, block.page, "exec", dont_inherit=True), names)
    return names


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with raw.mcap, a few steps, and with estimates: walk.mcap, other.mcap."""
    folder = tmp_path_factory.mktemp("recordings")
    raw = simulate("straight", folder / "raw", seed=1, length_m=2.8, rest_s=2.1)
    assert marcha("convert", *raw.paths, "-o", folder / "raw.mcap").code == 0
    done = marcha(
        "replay", folder / "raw.mcap", "-e", "foot.naive", "--input", "/foot/imu2", "-o", folder / "walk.mcap"
    )
    assert done.code == 0
    shutil.copy(folder / "walk.mcap", folder / "other.mcap")
    return folder


@pytest.fixture
def inside(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of one's own with those recordings, and the current one."""
    shutil.copytree(recordings, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_walkthrough_of_joints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sensor files and a marker file: three commands to the knee's error per cycle."""
    from .leg_files import xsens_and_markers

    xsens_and_markers(tmp_path)
    monkeypatch.chdir(tmp_path)
    first, second = [b for b in blocks(ROOT / "docs" / "joints.md", "bash") if b.runs][:2]
    three, said = commands(first.text), ""
    assert len(three) == 3
    for command in (*three, *commands(second.text)):
        done = marcha(*command.words)
        assert done.code == command.code, f"{command.words}\n{done.out}{done.err}"
        if command is three[-1]:
            said = done.out
    figures = dict(line.split()[:2] for line in said.splitlines() if ".knee" in line)
    assert float(figures["cycles.knee"]) > 10
    assert float(figures["cycle_rmse_deg.knee"]) < 4.0  # mounted 3° off on average
    assert float(figures["rmse_unbiased_deg.knee"]) < 1.0
    assert (tmp_path / "cycles.png").exists()


def test_python_of_replay(inside: Path) -> None:
    for block in blocks(ROOT / "docs" / "replay.md", "python"):
        names = run(block, {})
        assert [r.run for r in names["result"].runs][-1].startswith("slow")
    assert (inside / "done.mcap").exists()


def test_python_of_recording_format(inside: Path) -> None:
    imu = mr.open("raw.mcap").table("/foot/imu1")
    (inside / "walk.mcap").unlink()
    for block in blocks(ROOT / "docs" / "recording-format.md", "python"):
        names = run(block, {"imu": imu.clone()})
        assert names["imu"].equals(imu)
        assert names["message"].topic == "/foot/imu1"


def test_python_of_viewing(inside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, opened = viz.LiveSink, []

    def windowless(path: str, *, show: bool) -> viz.LiveSink:
        opened.append(show)
        return real(path)

    monkeypatch.setattr(viz, "LiveSink", windowless)
    monkeypatch.setattr(rp.engine, "SystemClock", rp.ManualClock)
    (inside / "walk.rrd").unlink(missing_ok=True)
    names: dict[str, Any] = {}
    for block in blocks(ROOT / "docs" / "viewing.md", "python"):
        run(block, names)
    assert opened == [True]
    assert {p.name for p in inside.iterdir()} >= {"walk.png", "both.rrd", "walk.rrd"}


def test_python_of_study(monkeypatch: pytest.MonkeyPatch) -> None:
    """The call fits the function; what a study does has tests of its own, and takes longer."""
    signature, calls = inspect.signature(study.run_study), []

    def called(*args: Any, **kwargs: Any) -> Any:
        calls.append(signature.bind(*args, **kwargs).arguments)
        given = {f: pl.DataFrame({"metric": ["EP"]}) for f in study.StudyResult.__struct_fields__}
        return SimpleNamespace(**given)

    monkeypatch.setattr(study, "run_study", called)
    for block in blocks(ROOT / "docs" / "study.md", "python"):
        run(block, {"__name__": "__main__"})
    assert [c["config"] for c in calls] == ["foot-tables"]


@pytest.mark.parametrize("block", SHELL, ids=lambda b: f"{b.page}:{b.line}")
def test_every_command_and_option_exists(block: Block) -> None:
    for command in commands(block.text):
        if "…" in command.words:
            continue
        build().parse_args(list(command.words), exit_on_error=False, print_error=False)
