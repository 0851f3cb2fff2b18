"""The page *mark and hand on*, followed by a stranger: three bad stretches marked, files that others open."""

from __future__ import annotations

import glob
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from marcha.viz.annotating import page as annotating
from marcha.viz.annotating.server import PageServer

from .cli_helpers import Ran, marcha
from .conftest import ROOT
from .docs_blocks import Block, blocks, commands
from .page_helpers import chromium, opened, until

PAGE = ROOT / "docs" / "mark-and-hand-on.md"


def run(block: Block) -> list[Ran]:
    """Run the commands of a block, patterns of files filled in as a shell does."""
    done = []
    for command in commands(block.text):
        words = [found for word in command.words for found in (sorted(glob.glob(word)) or [word])]
        done.append(marcha(*words))
        assert done[-1].code == command.code, f"{block.page}:{block.line}: {words}\n{done[-1].err}"
    return done


def stranger(server: PageServer) -> None:
    """Do what the page says under *Mark*, by mouse."""
    with chromium() as browser:
        page = opened(browser, server.address)
        page.locator("#label").fill("bad stretch")
        box = page.locator("#stage").bounding_box()
        assert box is not None
        for k in range(3):
            x, y = box["x"] + 200 + 200 * k, box["y"] + 400
            page.mouse.move(x, y)
            page.mouse.down()
            page.mouse.move(x + 80, y, steps=4)
            page.mouse.up()
            until(page, f"marcha.marks.unsaved === {k + 1}")
        page.locator("#save").click()
        until(page, "document.getElementById('saved').textContent === 'all saved'")
        page.close()


def test_a_stranger_gets_from_a_walk_to_files_that_others_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with chromium():  # skips here where there is no browser, before anything is made
        pass
    monkeypatch.chdir(tmp_path)
    make, mark, look, hand_on = blocks(PAGE)
    run(make)

    def by_mouse(server: PageServer) -> None:
        stranger(server)
        raise KeyboardInterrupt  # Ctrl-C in the terminal

    monkeypatch.setattr(PageServer, "wait", by_mouse)
    monkeypatch.setattr(annotating.webbrowser, "open", lambda address: True)
    (ran,) = run(mark)
    assert ran.out.startswith("walk.mcap: ")
    assert "0 not saved" in ran.out
    listed, log = run(look)
    assert listed.out.count("bad stretch") == 3
    assert "page" in log.out
    run(hand_on)

    marked = mr.open("walk.mcap")
    mine = marked.annotations.filter(tier="manual").sort("start_ns")
    events = pl.read_csv(
        "study/sub-01/motion/sub-01_task-walk_events.tsv", separator="\t", null_values="n/a"
    ).filter(trial_type="bad stretch")
    onset = (mine["start_ns"] - marked.start_ns) / 1e9
    assert (events["onset"].sort() - onset).abs().max() < 1e-6  # pyright: ignore[reportOptionalOperand, reportOperatorIssue]
    head, _, body = Path("walk.sto").read_text("utf-8").partition("endheader\n")
    assert "DataType=Quaternion" in head
    names, first = (line.split("\t") for line in body.splitlines()[:2])
    assert len(names) == len(first) > 1
    w, x, y, z = map(float, first[1].split(","))
    assert abs(w * w + x * x + y * y + z * z - 1) < 1e-9


def test_the_data_set_has_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shutil
    import subprocess
    import sys

    program = Path(sys.executable).with_name("bids-validator-deno")
    if not program.exists() and shutil.which("bids-validator-deno") is None:
        pytest.skip("bids-validator-deno is not installed")
    monkeypatch.chdir(tmp_path)
    make, _, _, hand_on = blocks(PAGE)
    run(make)
    for start in ("5", "11", "18"):
        add = (
            "annotate",
            "add",
            "walk.mcap",
            "--label",
            "bad stretch",
            "--from",
            start,
            "--to",
            f"{start}.9",
        )
        assert marcha(*add, "--in-place").code == 0
    run(hand_on)
    command = [str(program) if program.exists() else "bids-validator-deno", "study"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
