"""The annotating page with eight hours of four sensors, in a headless Chromium."""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from . import Row

HOURS, SENSORS, RATE_HZ = 8.0, 4, 100
SHOWN_S, FRAME_MS = 3.0, 50.0
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")

MOVES = """async ([kind, count]) => {
  const stage = document.getElementById("stage");
  const box = stage.getBoundingClientRect();
  const { view } = marcha;
  const middle = view.first + (view.last - view.first) * 0.43;
  view.whole();
  if (kind === "pan") view.zoom(0.02, middle);
  const took = [];
  let before = null;
  for (let k = 0; k < count; k++) {
    const way = kind === "zoom" ? { deltaY: k % 160 < 80 ? -110 : 110 } : { deltaX: k % 80 < 60 ? 120 : -90 };
    stage.dispatchEvent(new WheelEvent("wheel", { ...way, clientX: box.x + box.width * 0.43, clientY: box.y + 300,
      cancelable: true, bubbles: true }));
    const now = await new Promise(requestAnimationFrame);
    if (before !== null) took.push(now - before);
    before = now;
  }
  return took;
}"""
"""Wheel events, one a frame, from the whole recording down to single rows and back, or across; times between frames."""


def rows(scale: float = 1.0) -> list[Row]:
    """Measure the time until all is on screen, and the time between frames while zooming and panning."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        count = _write(path, scale)
        measured = _measure(path)
    if measured is None:
        print("page: no playwright or no Chromium: left out", file=sys.stderr)
        return []
    shown, frames = measured
    what = f"{count * SENSORS / 1e6:.1f} million samples of ten columns"
    found = [
        Row(f"Page: {what} on screen", shown, "s", "", None, None, f"at most {SHOWN_S:g} s", shown <= SHOWN_S)
    ]
    for kind, took in frames.items():
        share = statistics.quantiles(took, n=20)[-1]
        target = f"95 % of frames below {FRAME_MS:g} ms"
        found.append(
            Row(f"Page: {kind}, 95 % of frames", share, "ms", "", None, None, target, share < FRAME_MS)
        )
    return found


def _write(path: Path, scale: float) -> int:
    import marcha.recording as mr

    count = max(int(HOURS * 3600 * RATE_HZ * scale), 10_000)
    rng = np.random.default_rng(1)
    t_ns = 1_700_000_000_000_000_000 + np.arange(count) * (10**9 // RATE_HZ)
    phase = 2 * np.pi * np.arange(count) / RATE_HZ
    with mr.create(path) as out:
        for sensor in range(SENSORS):
            names = [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
            columns = {
                n: np.sin(phase + k) * (2 + np.sin(phase / 500)) + rng.normal(0, 0.2, count)
                for k, n in enumerate(names)
            }
            half = phase / 1000 + sensor
            columns |= {
                "quat_w": np.cos(half),
                "quat_x": 0 * half,
                "quat_y": 0 * half,
                "quat_z": np.sin(half),
            }
            for at in range(0, count, 100_000):
                cut = slice(at, at + 100_000)
                table = pl.DataFrame({"t_ns": t_ns[cut], **{n: v[cut] for n, v in columns.items()}})
                out.add_table(f"/sensor{sensor + 1}/imu", "sensor_msgs/msg/Imu", table, frame_id="imu")
    return count


def _measure(path: Path) -> tuple[float, dict[str, list[float]]] | None:
    """Return seconds from opening the recording to the whole picture, and times between frames, ms."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    import marcha.recording as mr
    from marcha.viz.annotating.server import PageServer
    from marcha.viz.annotating.session import Session

    with sync_playwright() as driver:
        own = Path(driver.chromium.executable_path)
        program = str(own) if own.exists() else next(filter(None, map(shutil.which, CHROMIUM)), None)
        if program is None:
            return None
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1600, "height": 900})
        begun = time.perf_counter()
        session = Session(mr.open(path), path.with_name("out.mcap"), action="page")
        with PageServer(session) as server:
            page.goto(server.address)
            while not page.evaluate(
                "() => window.marcha && !marcha.stage.dirty && marcha.channels.size > 0"
                " && [...marcha.channels.values()].every((c) => c.complete)"
            ):
                page.wait_for_timeout(20)
            shown = time.perf_counter() - begun
            frames: dict[str, Any] = {kind: page.evaluate(MOVES, [kind, 240]) for kind in ("zoom", "pan")}
        browser.close()
    return shown, frames
