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
    table = example_table("geometry_msgs/msg/TwistStamped")
    rec = write(tmp_path / "a.mcap", {"/body/twist": ("geometry_msgs/msg/TwistStamped", table)})
    _, canvas = drawn(rec, tmp_path)
    panels = {e.panel for e in canvas.entries if e.kind == "plot"}
    assert {"/body/twist (m/s)", "/body/twist (rad/s)"} <= panels


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


def test_the_eye_follows_markers_that_walk_away_and_is_as_near_as_their_size(tmp_path: Path) -> None:
    way = np.linspace(0.0, 30.0, 40)
    marks = {
        f"{n}.{a}": v
        for n, z in (("hip", 0.9), ("heel", 0.1))
        for a, v in zip("xyz", (0 * way, way, 0 * way + z), strict=True)
    }
    marks["heel.x"] = np.where(np.arange(40) % 5, marks["heel.x"], np.nan)  # hidden now and then
    topic, table = "/reference/markers", pl.DataFrame({"t_ns": np.arange(40) * 10**9, **marks})
    rec = write(tmp_path / "a.mcap", {topic: ("marcha_msgs/msg/OpticalMarkers", table)})
    _, canvas = drawn(rec, tmp_path)
    assert canvas.followed["markers"] == "/reference/markers/points"
    low, high = canvas.solid["markers"]
    assert 0.8 <= high[2] - low[2] < 1.6
    assert high[1] - low[1] < 1e-6  # not the way of 30 m


def test_a_point_of_the_markers_has_its_own_name_while_another_is_hidden(tmp_path: Path) -> None:
    table = pl.DataFrame(
        {"t_ns": [0, 10**9], **{f"{n}.{a}": [1.0, 1.0] for n in ("hip", "knee") for a in "xyz"}}
    )
    table = table.with_columns(pl.Series("hip.x", [np.nan, 1.0]), pl.Series("knee.x", [1.0, np.nan]))
    rec = write(tmp_path / "a.mcap", {"/reference/markers": ("marcha_msgs/msg/OpticalMarkers", table)})
    viz.write_rrd(rec, tmp_path / "a.rrd")
    from .test_viz_rrd import column

    _, names = column(tmp_path / "a.rrd", "/reference/markers/points", "Points3D:keypoint_ids")
    assert names[:, 0].tolist() == [1, 0]


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
        self.canvas.scalars(f"{self.path}/count", t_ns, np.asarray(values, np.float64))


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
    assert "missing (no_such_module:View" in said
    assert f"wrong ({__name__}:notes" in said
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


# -- phones, radio, legs -----------------------------------------------------------------------------


def test_a_phone_s_recording_is_on_the_map_with_its_accuracy(tmp_path: Path) -> None:
    from .test_viz_rrd import column
    from .viz_walks import phone

    rec = phone(tmp_path / "a.mcap", seconds=20)
    assert unseen(rec, tmp_path) == []
    path = tmp_path / "drawn.rrd"
    fix = rec.table("/phone/gnss")
    _, place = column(path, "/phone/gnss/map/fixes", "GeoPoints:positions")
    np.testing.assert_array_equal(place[:, 0], fix.select("lat_deg", "lon_deg").to_numpy())
    _, ring = column(path, "/phone/gnss/map/accuracy", "GeoLineStrings:line_strings")
    from pyproj import Geod

    lat, lon = ring[0, 0].T
    centre = fix.row(0, named=True)
    n = len(lat)
    _, _, gone = Geod(ellps="WGS84").inv([centre["lon_deg"]] * n, [centre["lat_deg"]] * n, lon, lat)
    np.testing.assert_allclose(gone, 5.0, atol=1e-3)


def test_steps_are_points_on_the_norm(tmp_path: Path) -> None:
    from .test_viz_rrd import column
    from .viz_walks import phone

    rec = phone(tmp_path / "a.mcap", seconds=20)
    viz.write_rrd(rec, tmp_path / "a.rrd")
    steps = rec.table("/estimate/phone_fused_phone_imu/step")
    t_ns, value = column(tmp_path / "a.rrd", "/run/phone_fused_phone_imu/step/on_norm", "Scalars:scalars")
    imu = rec.table("/phone/imu")
    norm = np.linalg.norm(imu.select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
    t = imu["t_ns"].to_numpy()
    np.testing.assert_array_equal(t_ns, steps["t_ns"].to_numpy() - t[0])
    np.testing.assert_allclose(value[:, 0], np.interp(t_ns, t - t[0], norm), atol=1e-9)


def test_ranges_are_circles_about_their_anchors_in_the_plane_of_the_floor(tmp_path: Path) -> None:
    from .test_viz_rrd import column
    from .viz_walks import ANCHORS, indoor

    rec = indoor(tmp_path / "a.mcap")
    assert unseen(rec, tmp_path) == []
    mac = "00:00:00:00:00:01"
    x, y, _ = ANCHORS[mac][1]
    entity = f"/run/indoor_trilateration/ranges/circle/{rr.escape_entity_path_part(mac)}"
    _, ring = column(tmp_path / "drawn.rrd", entity, "LineStrips3D:strips")
    ranges = rec.table("/estimate/indoor_trilateration/ranges").filter(pl.col("mac") == mac)
    for strip, plane in zip(
        ring[:, 0], ranges["distance_m"], strict=True
    ):  # a run's are in the plane already
        radius = np.hypot(strip[:, 0] - x, strip[:, 1] - y)
        np.testing.assert_allclose(radius, plane, rtol=1e-5)


def test_the_ellipse_is_that_of_95_percent_about_the_position(tmp_path: Path) -> None:
    from scipy.stats import chi2

    from .test_viz_rrd import column
    from .viz_walks import indoor

    rec = indoor(tmp_path / "a.mcap")
    viz.write_rrd(rec, tmp_path / "a.rrd")
    _, ring = column(tmp_path / "a.rrd", "/run/indoor_fused/ellipse", "LineStrips3D:strips")
    at = rec.table("/estimate/indoor_fused/position").select("pos_x", "pos_y").to_numpy()
    sigma = rec.table("/estimate/indoor_fused/sigma").select("sigma_pos_x", "sigma_pos_y").to_numpy()
    assert len(ring) == len(at)
    for strip, centre, sd in zip(ring[:, 0], at, sigma, strict=True):
        squared = np.sum(((strip[:, :2] - centre) / sd) ** 2, axis=1)
        np.testing.assert_allclose(squared, chi2.ppf(0.95, 2), rtol=1e-4)


def test_a_picture_of_the_floor_lies_where_it_says_and_a_broken_one_is_named(tmp_path: Path) -> None:
    from marcha.viz.floor import floor_plan, loaders_of

    from .viz_walks import indoor, with_picture

    indoor(tmp_path / "a.mcap")
    rec = with_picture(tmp_path / "a.mcap", tmp_path / "b.mcap")
    plan = floor_plan(loaders_of(rec))
    assert plan.corners == (0.0, 13.0, 0.0, 8.0)
    assert plan.picture is not None
    assert plan.picture[0, 0].tolist() == [250, 90, 90]
    assert set(plan.anchors) == {f"00:00:00:00:00:0{i}" for i in range(1, 5)}
    with pytest.warns(UserWarning, match=r"attachment anchors\.csv: not drawn"):
        assert floor_plan({"anchors.csv": lambda: b"mac,x\n1,2\n"}).anchors == {}


def test_a_plan_in_degrees_is_laid_out_in_metres() -> None:
    import json

    from marcha.viz.floor import floor_plan

    corner, step = (121.5, 31.2), 0.001
    ring = [[corner[0], corner[1]], [corner[0] + step, corner[1]], [corner[0] + step, corner[1] + step]]
    shape = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": ring}}
    (line,) = floor_plan({"plan.geojson": lambda: json.dumps(shape).encode()}).outlines
    from pyproj import Geod

    earth = Geod(ellps="WGS84")
    _, _, east = earth.inv(ring[0][0], ring[0][1], ring[1][0], ring[1][1])
    _, _, north = earth.inv(ring[1][0], ring[1][1], ring[2][0], ring[2][1])
    np.testing.assert_allclose(line, [[0, 0], [east, 0], [east, north]], rtol=1e-4, atol=1e-9)


def test_a_joint_s_error_is_estimate_minus_reference_within_its_band(tmp_path: Path) -> None:
    from .test_viz_rrd import column
    from .viz_walks import leg

    rec = leg(tmp_path / "a.mcap")
    assert unseen(rec, tmp_path) == []
    path = tmp_path / "drawn.rrd"
    t_ns, error = column(path, "/run/joint_smea/joint/knee/error", "Scalars:scalars")
    np.testing.assert_allclose(error[:, 0], 1.5 * np.sin(t_ns / 1e9), atol=0.1)  # not the encoder's 1.7°
    _, variance = column(path, "/run/joint_smea/sigma/knee/band", "Measurements:variances")
    np.testing.assert_allclose(np.sqrt(variance), 1.2, rtol=1e-6)
    _, error = column(path, "/run/joint_smea/attitude/thigh_roll/error", "Scalars:scalars")
    assert np.abs(error).max() < 0.1


def test_the_three_angles_of_a_joint_lie_behind_each_other(tmp_path: Path) -> None:
    table = pl.DataFrame(
        {"t_ns": [0, 10**9]} | {k: [0.0, 0.1] for k in ("knee", "knee_abduction", "hip_rotation")}
    )
    rec = write(tmp_path / "a.mcap", {"/reference/joint": ("sensor_msgs/msg/JointState", table)})
    _, canvas = drawn(rec, tmp_path)
    stacks = {e.panel: e.stack for e in canvas.entries if e.panel.endswith("angle (°)")}
    assert stacks == {
        "knee angle (°)": "knee angle",
        "knee_abduction angle (°)": "knee angle",
        "hip_rotation angle (°)": "hip angle",
    }


def test_a_segment_hangs_at_the_end_of_the_one_above(tmp_path: Path) -> None:
    from .test_viz_rrd import column
    from .viz_walks import leg

    rec = leg(tmp_path / "a.mcap")
    viz.write_rrd(rec, tmp_path / "a.rrd")
    t_ns, at = column(tmp_path / "a.rrd", "/reference/figure/shank", "Transform3D:translation")
    s = t_ns / 1e9
    thigh = np.radians(25.0) * np.sin(2 * np.pi * 0.8 * s)
    knee = np.column_stack([0 * s, 0.42 * np.sin(thigh), -0.42 * np.cos(thigh)])
    np.testing.assert_allclose(at[:, 0], knee, atol=1e-5)


def test_jump_states_and_what_is_used_are_lanes(tmp_path: Path) -> None:
    from .test_viz_rrd import column
    from .viz_walks import leg

    rec = leg(tmp_path / "a.mcap")
    viz.write_rrd(rec, tmp_path / "a.rrd")
    _, state = column(tmp_path / "a.rrd", "/run/joint_smea/jump/state", "StateChange:state")
    assert set(state[:, 0]) == {"thigh", "shank", "all", ""}
    _, used = column(tmp_path / "a.rrd", "/run/joint_smea/use/thigh", "StateChange:state")
    assert set(used[:, 0]) == {"used", ""}
