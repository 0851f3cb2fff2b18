"""Views by registry: every channel of any type reaches a panel, plug-ins draw, and a broken one is named."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import marcha.recording as mr
import marcha.viz as viz
import numpy as np
import polars as pl
import pytest
import rerun as rr
from marcha.algorithms import available, make
from marcha.recording.schemas import SCHEMAS
from marcha.viz import registry
from marcha.viz.canvas import Times
from marcha.viz.registry import available_views
from marcha.viz.scene import overlap_levels
from marcha.viz.text import printable
from marcha.viz.views import View

from .contracts.view import ViewContract
from .test_recording_foreign import ODD, odd_bytes, raw_writer
from .viz_helpers import drawn, example_table, is_shown, shown_by, write


@pytest.fixture(autouse=True)
def _strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Install classes of this module as plug-ins beside the built-in views."""
    real = registry.entry_points(group=registry.GROUP)

    def install(**points: str) -> None:
        extra = [EntryPoint(n, v, registry.GROUP) for n, v in points.items()]
        monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints([*real, *extra]))

    return install


def unseen(rec: mr.Recording, folder: Path) -> list[str]:
    """Return the topics of which no panel shows anything that holds data."""
    entities, canvas = drawn(rec, folder)
    contents = shown_by([canvas])
    visible = {e for e in entities if is_shown(e, contents)}
    return [
        t
        for t in rec.channels
        if not any(
            e.startswith((canvas.group(t), f"/log{canvas.group(t)}", canvas.base(t) + "/trail"))
            for e in visible
        )
    ]


@pytest.mark.parametrize("place", ["", "/estimate/mine", "/reference"])
def test_every_message_type_reaches_a_panel(place: str, tmp_path: Path) -> None:
    channels = {
        f"{place}/{name.rsplit('/', 1)[-1].lower()}": (name, example_table(name)) for name in sorted(SCHEMAS)
    }
    if place == "/reference":  # two tracks: the second is the truth of a sensor that nothing reads
        del channels["/reference/pointstamped"]
    rec = write(tmp_path / "a.mcap", channels)
    assert unseen(rec, tmp_path) == []


def test_every_output_of_every_estimator_reaches_a_panel(tmp_path: Path) -> None:
    channels = {
        f"/estimate/{name.replace('.', '_').replace('-', '_')}/{output.name}": (
            output.schema,
            example_table(output.schema, output.columns if SCHEMAS[output.schema].names else ()),
        )
        for name in available()
        for output in make(name).outputs
    }
    assert len(channels) > 20
    rec = write(tmp_path / "a.mcap", channels)
    assert unseen(rec, tmp_path) == []


def test_a_foreign_message_of_any_content_reaches_panels(tmp_path: Path) -> None:
    rows = [("/odd", i * 10**6, odd_bytes(i)) for i in range(12)]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows, ("/odd",), "pkg/msg/Odd", ODD))
    entities, canvas = drawn(rec, tmp_path)
    contents = shown_by([canvas])
    visible = {e for e in entities if is_shown(e, contents)}
    assert "/log/odd" in visible  # text and lists
    assert "/odd/on" in visible  # a flag, as a lane
    assert "/odd" in visible  # numbers
    viz.write_rrd(rec, tmp_path / "a.rrd")


def test_a_known_name_with_other_fields_is_drawn_as_what_it_holds(tmp_path: Path) -> None:
    rows = [("/odd", i * 10**6, odd_bytes(i)) for i in range(12)]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows, ("/odd",), "sensor_msgs/msg/Imu", ODD))
    assert unseen(rec, tmp_path) == []


def test_numbers_of_several_units_have_a_panel_a_unit(tmp_path: Path) -> None:
    table = example_table("sensor_msgs/msg/NavSatFix")
    rec = write(tmp_path / "a.mcap", {"/phone/gnss": ("sensor_msgs/msg/NavSatFix", table)})
    _, canvas = drawn(rec, tmp_path)
    panels = {e.panel for e in canvas.entries if e.kind == "plot"}
    assert {"/phone/gnss (°)", "/phone/gnss (m)"} <= panels


def test_numbered_states_are_lanes_with_the_names_that_the_channel_gives_them(tmp_path: Path) -> None:
    table = pl.DataFrame({"t_ns": np.arange(4) * 10**9, "jump": [0.0, 0.0, 2.0, np.nan]})
    topic = "/estimate/smea/jump"
    rec = write(
        tmp_path / "a.mcap",
        {topic: ("marcha_msgs/msg/NamedValues", table)},
        **{topic: {"states.jump": "T,S,TS", "states": "unused"}},
    )
    viz.write_rrd(rec, tmp_path / "a.rrd")
    from .test_viz_rrd import column

    t_ns, states = column(tmp_path / "a.rrd", "/run/smea/jump/jump", "StateChange:state")
    assert states[:, 0].tolist() == ["T", "TS", ""]
    assert t_ns.tolist() == [0, 2 * 10**9, 3 * 10**9]


# -- annotations -------------------------------------------------------------------------------------


def notes(*rows: tuple[int, int, str]) -> pl.DataFrame:
    start, end, label = zip(*rows, strict=True)
    return pl.DataFrame(
        {
            "tier": ["t"] * len(rows),
            "start_ns": [s * 10**9 for s in start],
            "end_ns": [e * 10**9 for e in end],
            "label": label,
            "metadata": ["{}"] * len(rows),
        }
    )


def annotated(folder: Path, table: pl.DataFrame) -> Path:
    with mr.create(folder / "a.mcap") as out:
        rows = pl.DataFrame({"t_ns": np.arange(31) * 10**9, "temperature_c": 20.0})
        out.add_table("/x", "sensor_msgs/msg/Temperature", rows)
        out.add_annotations(table)
    return viz.write_rrd(mr.open(folder / "a.mcap"), folder / "a.rrd")


def test_of_two_overlapping_intervals_each_is_seen_to_its_end(tmp_path: Path) -> None:
    from .test_viz_rrd import column

    path = annotated(tmp_path, notes((1, 20, "long"), (5, 8, "short"), (10, 12, "next")))
    t_ns, label = column(path, "/annotation/t", "StateChange:state")
    assert list(zip((t_ns // 10**9).tolist(), label[:, 0], strict=True)) == [(1, "long"), (20, "")]
    t_ns, label = column(path, "/annotation/t/overlap2", "StateChange:state")
    assert list(zip((t_ns // 10**9).tolist(), label[:, 0], strict=True)) == [
        (5, "short"),
        (8, ""),
        (10, "next"),
        (12, ""),
    ]


def test_an_instant_is_a_point_and_no_state(tmp_path: Path) -> None:
    from .test_viz_rrd import column, entities

    path = annotated(tmp_path, notes((3, 3, "turn"), (4, 4, "turn")))
    t_ns, _ = column(path, "/annotation/t/instants", "Scalars:scalars")
    assert (t_ns // 10**9).tolist() == [3, 4]
    assert "/annotation/t" not in entities(path)


def test_no_lane_holds_two_intervals_at_once() -> None:
    rng = np.random.default_rng(5)
    start = np.sort(rng.integers(0, 1000, 200))
    end = start + rng.integers(1, 80, 200)
    levels = overlap_levels(start, end)
    deepest = max(int(np.sum((start <= t) & (end > t))) for t in range(1100))
    assert levels.max() + 1 == deepest  # no more lanes than needed
    for level in range(deepest):
        mine = levels == level
        assert (start[mine][1:] >= end[mine][:-1]).all()


# -- plug-ins ----------------------------------------------------------------------------------------


class Breath(View):
    """A view as somebody else would write it."""

    title = "breathing of a chest strap"
    schemas = ("marcha_msgs/msg/NamedValues",)
    roles = ("raw",)
    needs = ("breath_hz",)

    def begin(self) -> None:
        self.canvas.lines(self.path, ["breathing (1/s)"], [self.color])
        self.canvas.show("plot", self.path, tab="Breath", panel="breathing (1/s)", owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        self.canvas.scalars(self.path, t_ns, block["breath_hz"].to_numpy())


class Count(View):
    """Draws beside the channel's own view."""

    title = "number of messages so far"
    schemas = ("marcha_msgs/msg/NamedValues",)
    beside = True

    def begin(self) -> None:
        self.count = 0
        self.canvas.show("plot", f"{self.path}/count", tab=self.tab, panel="messages", owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        values = self.count + 1.0 + np.arange(len(t_ns))
        self.count += len(t_ns)
        self.canvas.scalars(f"{self.path}/count", t_ns, values)


class Broken(Breath):
    """Fails when it draws."""

    priority = 5

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        raise ZeroDivisionError("no breath")


class TestBreath(ViewContract):
    """The contract, as a plug-in's author inherits it."""

    view = Breath

    def table(self) -> tuple[str, str, pl.DataFrame]:
        t_ns = np.arange(50) * 10**8
        return (
            "/strap/breath",
            "marcha_msgs/msg/NamedValues",
            pl.DataFrame({"t_ns": t_ns, "breath_hz": 0.25 + 0 * t_ns}),
        )


class TestCount(TestBreath):
    view = Count


@pytest.fixture
def strap(tmp_path: Path) -> mr.Recording:
    topic, schema, table = TestBreath().table()
    return write(tmp_path / "strap.mcap", {topic: (schema, table)})


def test_a_plug_in_s_view_gets_its_channel_and_a_tab_of_its_own(
    strap: mr.Recording, tmp_path: Path, plugins: Any
) -> None:
    plugins(breath=f"{__name__}:Breath", count=f"{__name__}:Count")
    entities, canvas = drawn(strap, tmp_path)
    assert {"/strap/breath", "/strap/breath/count"} <= entities
    assert "/strap/breath/breath_hz" not in entities  # the built-in one stands back
    assert {e.tab for e in canvas.entries} >= {"Breath"}
    assert unseen(strap, tmp_path) == []


def test_a_plug_in_that_does_not_load_is_a_warning_with_its_name(plugins: Any) -> None:
    plugins(missing="no_such_module:View", wrong=f"{__name__}:notes")
    with pytest.warns(UserWarning, match="view plug-in") as caught:
        found = available_views()
    said = " ".join(str(w.message) for w in caught)
    assert "missing (no_such_module:View)" in said
    assert f"wrong ({__name__}:notes)" in said
    assert "imu" in found


def test_a_plug_in_that_fails_is_named_and_its_channel_still_drawn(
    strap: mr.Recording, tmp_path: Path, plugins: Any
) -> None:
    plugins(broken=f"{__name__}:Broken")
    with pytest.warns(UserWarning, match=r"view plug-in broken .* failed on /strap/breath: .*no breath"):
        entities, _ = drawn(strap, tmp_path)
    assert "/strap/breath" in entities


def test_built_in_views_load_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = available_views()
    assert {"imu", "positions", "fix", "signals", "angles", "general"} <= set(found)
    assert all(v.title for v in found.values())


# -- texts from files --------------------------------------------------------------------------------


def test_nothing_from_a_file_keeps_a_control_character(tmp_path: Path) -> None:
    bad = "\x1b[31mred\x07\u202e"
    table = example_table("marcha_msgs/msg/NamedValues").select("t_ns", pl.col("one").alias(f"v{bad}"))
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table(f"/a{bad}/b", "marcha_msgs/msg/NamedValues", table)
        out.add_annotations(notes((1, 2, bad)).with_columns(tier=pl.lit(bad)))
        out.add_metadata(f"device{bad}", {"name": bad})
    path = viz.write_rrd(mr.open(tmp_path / "a.mcap"), tmp_path / "a.rrd")
    from rerun.chunk import RrdReader

    texts = [
        f"{c.entity_path} {name} {column.to_pylist()}"
        for c in RrdReader(path).stream()
        for name, column in zip(c.to_record_batch().schema.names, c.to_record_batch().columns, strict=True)
        if not name.startswith("rerun.controls")  # ids of rows are any bytes
    ]
    signs = ("\x1b", "\x07", "\u202e", "\\x1b", "\\x07", "\\u202e")
    assert [text for text in texts for c in signs if c in text] == []


@pytest.mark.parametrize(
    ("text", "shown"),
    [("plain", "plain"), ("a\tb\nc", "a b c"), ("\x1b[1m", "\ufffd[1m"), ("naïve ‖σ", "naïve ‖σ")],
)
def test_printable(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_drawing_again_and_again_keeps_threads_and_memory_flat(strap: mr.Recording, tmp_path: Path) -> None:
    import psutil

    process = psutil.Process()
    viz.write_rrd(strap, tmp_path / "a.rrd")
    before = process.num_threads()
    for _ in range(8):
        viz.write_rrd(strap, tmp_path / "a.rrd", overwrite=True)
    assert process.num_threads() <= before + 1
