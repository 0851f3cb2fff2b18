"""Make every picture of README and docs: ``python docs/make_pictures.py [FOLDER]``, by default docs/images.

Simulates walks, converts, replays, and takes the viewer's picture without a window (software Vulkan is
enough: Debian's mesa-vulkan-drivers and libvulkan1). Pictures of views that complain are not written.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import marcha.ingest as ingest
import marcha.recording as mr
import marcha.replay as rp
import marcha.viz as viz
import polars as pl
from marcha.export import export
from marcha.ingest.simulate import simulate
from marcha.recording.changes import change
from marcha.viz.recording_page import recordings_page
from marcha.viz.screenshot import Screenshot, screenshots

IMAGES = Path(__file__).parent / "images"
SENSOR = "/foot/imu2"
FILTERS = ("foot.9iez", "foot.15iez-zaru", "foot.naive")
DETECTORS = (
    "c1c2c3=foot.9iez[detector=c1c2c3]",
    "shoe=foot.9iez[detector=shoe]",
    "pitch=foot.9iez[detector=pitch]",
)
FRAME = 36
"""Height of the window's own bar, pixels."""


def replayed(folder: Path, scenario: str, estimators: tuple[str, ...], name: str) -> mr.Recording:
    """Simulate a walk, convert it, and replay it through ``estimators``."""
    raw = simulate(scenario, folder / name, seed=1)
    walk = folder / f"{name}.raw.mcap"
    ingest.convert(raw.paths, walk)
    rp.replay(mr.open(walk), estimators, inputs=[SENSOR], out=folder / f"{name}.mcap")
    return mr.open(folder / f"{name}.mcap")


def save(picture: Screenshot, path: Path) -> None:
    """Write a picture without the window's bar."""
    from PIL import Image

    if picture.reports:
        raise SystemExit(f"{path.name}: {'; '.join(picture.reports)}")
    image = Image.open(io.BytesIO(picture.png)).convert("RGB")
    image.crop((0, FRAME, *image.size)).quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path)


def domains(folder: Path, images: Path) -> None:
    """Take the pictures of a phone, of radio indoors and of a leg, from the small recordings of the tests."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tests import viz_walks

    for name, tab in (("phone", "Overview"), ("indoor", "Overview"), ("leg", "Joints")):
        rec = getattr(viz_walks, name)(folder / f"{name}.mcap")
        rrd = viz.write_rrd(rec, folder / f"{name}.rrd")
        for picture in screenshots(rrd, [tab], at=0.7):
            save(picture, images / f"viewer-{name}.png")


def plain(recording: Path, image: Path) -> None:
    """Take the picture of a recording as Rerun opens it without marcha (``rerun FILE.mcap``)."""
    from marcha.viz import viewer
    from PIL import Image
    from rerun.experimental import ViewerClient

    with viewer.native(headless=True, size=(1400, 800)) as process:
        client = ViewerClient.connect(viewer.uri(process.port))
        client.open(str(recording.resolve()))
        until = time.monotonic() + 60
        while time.monotonic() < until and not ((s := client.get_state()).recordings and not s.loading):
            time.sleep(0.1)
        time.sleep(4)  # plots find their bounds some frames later
        shot = Image.open(io.BytesIO(client.take_screenshot())).convert("RGB")
    shot.quantize(64, dither=Image.Dither.NONE).save(image, optimize=True)
    print(image)


def page(folder: Path, image: Path) -> None:
    """Take the picture of a report's part by label, where a Chromium is installed."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print(f"{image}: left as it is, there is no chromium")
        return
    from PIL import Image

    raw = simulate("walking", folder / "leg", seed=3)
    ingest.convert(raw.paths, folder / "leg.raw.mcap")
    rec = mr.open(folder / "leg.raw.mcap")
    at = [rec.start_ns + round(rec.duration_s * 1e9 * share) for share in (0.1, 0.33, 0.5, 0.75)]
    marks = {"tier": ["terrain"] * 2, "label": ["grass", "gravel"], "start_ns": at[::2], "end_ns": at[1::2]}
    rp.replay(rec, ["joint.hinge"], out=folder / "leg.done.mcap")
    change(mr.open(folder / "leg.done.mcap"), folder / "leg.mcap", add=pl.DataFrame(marks))
    html = recordings_page([mr.open(folder / "leg.mcap")], picture=False)
    hidden = "<style>main > :not(#s3, #s3 ~ *) { display: none }</style>"  # only what is by label
    (folder / "leg.html").write_text(html.replace("<body>", f"<body>{hidden}"), encoding="utf-8")
    shot = folder / "page.png"
    options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1300,1400"]
    subprocess.run([chromium, *options, f"--screenshot={shot}", str(folder / "leg.html")], check=True)
    Image.open(shot).convert("RGB").quantize(240, dither=Image.Dither.NONE).save(image, optimize=True)
    print(image)
    plain(folder / "leg.mcap", image.with_name("rerun-plain.png"))


def tracks(walk: mr.Recording, image: Path) -> None:
    """Take the picture of tracks as Rerun opens them without marcha."""
    export(walk, "mcap", walk.path.with_name("tracks.mcap"), options={"tracks": True})
    plain(walk.path.with_name("tracks.mcap"), image)


def marked(walk: mr.Recording, folder: Path) -> mr.Recording:
    """Mark three bad stretches in a walk."""
    zero = walk.start_ns or 0
    stretches = pl.DataFrame(
        {
            "tier": "manual",
            "start_ns": [zero + round(t * 1e9) for t in (5.1, 11.4, 18.3)],
            "end_ns": [zero + round(t * 1e9) for t in (6.3, 13.2, 19.0)],
            "label": "bad stretch",
            "source": "human:eva",
        }
    )
    change(walk, folder / "walk.mcap", add=stretches, action="page", by="eva")
    return mr.open(folder / "walk.mcap")


def annotating(walk: mr.Recording, folder: Path, images: Path) -> None:
    """Take the pictures of the annotating page and of the viewer while marking."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    import rerun as rr
    from marcha.viz.annotating import Session
    from marcha.viz.annotating.server import PageServer
    from marcha.viz.draw import draw
    from marcha.viz.stream import finish, new_stream
    from PIL import Image

    from tests.page_helpers import chromium, opened, until

    stream = new_stream()
    stream.set_sinks(rr.FileSink(folder / "annotate.rrd"))
    draw([walk], stream, annotating=True)
    finish(stream)
    for picture in screenshots(folder / "annotate.rrd", ["Overview"], at=0.62):
        save(picture, images / "viewer-annotate.png")
    session = Session(walk, walk.path, by="eva", overwrite=True, action="page")
    with chromium() as browser, PageServer(session) as server:
        page = opened(browser, server.address, (1400, 800))
        page.locator("#label").fill("bad stretch")
        page.keyboard.press("Escape")
        page.evaluate(
            "() => { const mine = marcha.marks.sorted().filter((r) => r.tier === 'manual');"
            " marcha.view.start = 4e9; marcha.view.end = 21e9;"
            " marcha.select(mine[1].id); marcha.setCursor(mine[1].end_ns); }"
        )
        first = "document.getElementById('list').tBodies[0].rows[0].cells[0].textContent"
        until(page, f"parseFloat({first}) > 3")  # the list follows the view a little later
        image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        image.quantize(64, dither=Image.Dither.NONE).save(images / "page.png", optimize=True)
        print(images / "page.png")


def main() -> None:
    """Make all pictures."""
    images = Path(sys.argv[1]) if len(sys.argv) > 1 else IMAGES
    images.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        domains(folder, images)
        page(folder, images / "report.png")
        walk = replayed(folder, "rectangle", FILTERS, "rectangle")
        tracks(walk, images / "rerun-tracks.png")
        rrd = viz.write_rrd(walk, folder / "rectangle.rrd")
        for picture in screenshots(rrd, ["Overview", "Raw", "Compare", "Report"], at=0.62):
            save(picture, images / f"viewer-{picture.tab.lower()}.png")
        detectors = replayed(folder, "rectangle", DETECTORS, "detectors")
        rrd = viz.write_rrd(detectors, folder / "detectors.rrd")
        for picture in screenshots(rrd, ["Detector"], at=0.62):
            save(picture, images / "viewer-detector.png")
        print(viz.save_figure(walk, images / "figure.png", overwrite=True))
        annotating(marked(replayed(folder, "rectangle", FILTERS[:1], "marked"), folder), folder, images)
        others = [replayed(folder, name, FILTERS[:2], name) for name in ("figure-eight", "stairs")]
        print(viz.save_figure(others, images / "figure-several.png", overwrite=True))


if __name__ == "__main__":
    main()
