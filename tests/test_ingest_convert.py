"""From a raw log to a recording: finding the format, provenance, truth, strictness, what stays on disk."""

from __future__ import annotations

import errno
import hashlib
import json
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any, ClassVar

import marcha.recording as mr
import msgspec
import polars as pl
import pytest
from marcha.ingest import (
    ChannelSpec,
    CommonOptions,
    Converted,
    Import,
    ReportBuilder,
    convert,
    importers,
    known_formats,
    recognise,
    registry,
)
from marcha.ingest.simulate import simulate
from marcha.recording import MarchaError, OutputExists, UsageError


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """A clean simulated walk with its truth beside it."""
    return simulate("rectangle", tmp_path / "raw", seed=2, drop_share=0.0).paths[0]


def rows_of(path: Path) -> int:
    return sum(1 for x in path.read_bytes().splitlines() if x.strip())


def leftovers(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name != "raw")


def test_result_says_what_is_in_the_file(walk: Path, tmp_path: Path) -> None:
    done = convert(walk, tmp_path / "walk.mcap")
    assert isinstance(done, Converted)
    assert done.format == "mpu6050-serial"
    rec = mr.open(tmp_path / "walk.mcap")
    assert {c.topic: (c.schema, c.count, c.start_ns, c.end_ns) for c in done.channels} == {
        t: (c.schema, c.count, c.start_ns, c.end_ns) for t, c in rec.channels.items()
    }
    assert done.channels[0].count == rows_of(walk)
    text = json.loads(msgspec.json.encode(done))
    assert set(text) == {"output", "format", "channels", "report", "also_read"}
    assert set(text["channels"][0]) == {"topic", "schema", "count", "start_ns", "end_ns"}
    assert {"rows_read", "rows_kept", "rows_repaired", "rows_dropped", "findings"} <= set(text["report"])


def test_provenance(walk: Path, tmp_path: Path) -> None:
    convert(walk, tmp_path / "walk.mcap", options={"keep_source": "true"}, truth={"length_m": "20"})
    rec = mr.open(tmp_path / "walk.mcap")
    record = rec.metadata["provenance"]
    sources = {s["name"]: s for s in json.loads(record["sources"])}
    assert sources[walk.name]["size"] == walk.stat().st_size
    assert sources[walk.name]["blake2b"] == hashlib.blake2b(walk.read_bytes()).hexdigest()
    assert record["importer"] == "mpu6050-serial"
    assert record["importer_version"].startswith("marcha ")
    assert json.loads(record["options"]) == {"length_m": "20", "keep_source": "true"}
    assert rec.attachment(f"source/{walk.name}") == walk.read_bytes()
    assert rec.metadata["device"]["clock"] == "device"
    report = rec.metadata["import_report"]
    assert int(report["rows_kept"]) == rows_of(walk)
    assert isinstance(json.loads(report["findings"]), list)
    assert rec.channels["/foot/imu1"].metadata["full_scale_acc_g"] == "16"


def test_truth_beside_the_log_becomes_reference(walk: Path, tmp_path: Path) -> None:
    convert(walk, tmp_path / "walk.mcap")
    rec = mr.open(tmp_path / "walk.mcap")
    truth = pl.read_csv(walk.with_name(f"{walk.stem}.truth.csv"))
    pose = rec.table("/reference/pose")
    assert pose["t_ns"].to_list() == truth["t_ns"].to_list()
    for column in ("pos_x", "pos_y", "pos_z", "quat_w", "quat_z"):
        assert pose[column].to_list() == truth[column].to_list()
    assert rec.table("/reference/velocity")["vel_x"].to_list() == truth["vel_x"].to_list()
    assert rec.table("/reference/stance")["still"].cast(pl.Int64).to_list() == truth["still"].to_list()
    assert "/reference/imu2/pose" in rec.channels
    assert rec.metadata["truth"]["closed"] == "true"
    assert float(rec.metadata["truth"]["length_m"]) == pytest.approx(22.1)


def test_everything_that_a_capture_suffers(tmp_path: Path) -> None:
    """Roll-over, chatter, wall clock, cut ends, dropped and doubled rows: named, and truth still in step."""
    options = {"boot_chatter": True, "cut_first": True, "cut_last": True, "wall_clock": True}
    damage = {"drop_share": 0.01, "duplicate_share": 0.01, "start_ms": 2**32 - 9000}
    log = simulate("rectangle", tmp_path / "raw", seed=4, **options, **damage).paths[0]
    done = convert(log, tmp_path / "walk.mcap")
    found = {f.kind for f in done.report.findings}
    assert {"counter_rollover", "chatter", "bad_row", "duplicate_row", "gap"} <= found
    assert done.report.lossy
    rec = mr.open(tmp_path / "walk.mcap")
    truth = set(rec.table("/reference/pose")["t_ns"].to_list())
    imu = rec.table("/foot/imu1")["t_ns"]
    assert set(imu.to_list()) <= truth
    assert imu.is_sorted()
    assert len(imu) > 0.95 * len(truth)
    assert "wall_clock_first" in rec.metadata["device"]


def test_truth_by_option(walk: Path, tmp_path: Path) -> None:
    for side in walk.parent.glob("*.truth.*"):
        side.unlink()
    convert(walk, tmp_path / "walk.mcap", options={"closed": "true"}, truth={"length_m": 22.1})
    rec = mr.open(tmp_path / "walk.mcap")
    assert rec.metadata["truth"] == {"closed": "true", "length_m": "22.1"}
    assert set(rec.channels) == {"/foot/imu1", "/foot/imu2"}


def test_damaged_truth_is_an_error(walk: Path, tmp_path: Path) -> None:
    walk.with_name(f"{walk.stem}.truth.toml").write_text("closed = perhaps")
    with pytest.raises(MarchaError, match=r"truth\.toml: not TOML"):
        convert(walk, tmp_path / "walk.mcap")
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize(("option", "at"), [("epoch", 1_600_000_000 * 10**9), ("start", None)])
def test_device_clock_to_utc(walk: Path, tmp_path: Path, option: str, at: int | None) -> None:
    plain = convert(walk, tmp_path / "a.mcap").channels[0]
    moved = convert(walk, tmp_path / "b.mcap", options={option: "2020-09-13T12:26:40Z"}).channels[0]
    assert plain.start_ns is not None
    assert moved.start_ns == (1_600_000_000 * 10**9 + (plain.start_ns if at else 0))
    rec = mr.open(tmp_path / "b.mcap")
    assert rec.metadata["device"]["clock"] == "utc"
    assert rec.channels["/reference/pose"].start_ns == rec.channels["/foot/imu1"].start_ns


def test_strict_refuses_at_the_line(walk: Path, tmp_path: Path) -> None:
    convert(walk, tmp_path / "clean.mcap", strict=True)
    lines = walk.read_bytes().split(b"\r\n")
    lines[100] = b"garbage,1,2"
    walk.write_bytes(b"\r\n".join(lines))
    with pytest.raises(MarchaError, match=rf"{walk.name}, line 101: bad_row: .*--strict"):
        convert(walk, tmp_path / "strict.mcap", strict=True)
    assert convert(walk, tmp_path / "loose.mcap").report.lossy
    assert leftovers(tmp_path) == ["clean.mcap", "loose.mcap"]


def test_output_is_never_overwritten_unasked(walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.mcap"
    out.write_bytes(b"precious")
    with pytest.raises(OutputExists):
        convert(walk, out)
    assert out.read_bytes() == b"precious"
    convert(walk, out, overwrite=True)
    assert mr.open(out).channels


def test_output_that_is_the_source(walk: Path) -> None:
    before = walk.read_bytes()
    with pytest.raises(UsageError, match="input itself"):
        convert(walk, walk, overwrite=True)
    assert walk.read_bytes() == before


def test_output_that_is_a_folder(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(MarchaError, match="is a folder"):
        convert(walk, tmp_path)


def test_failed_overwrite_keeps_the_old_file(walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.mcap"
    out.write_bytes(b"precious")
    walk.write_bytes(b"1,2,3\n" * 50)
    with pytest.raises(MarchaError):
        convert(walk, out, format="mpu6050-serial", overwrite=True)
    assert out.read_bytes() == b"precious"
    assert leftovers(tmp_path) == ["walk.mcap"]


def test_full_disk(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(MarchaError, match="No space left"):
        convert(walk, tmp_path / "walk.mcap")
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: None, "no such file"),
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.mkdir(), "holds no files"),
        (lambda p: p.write_bytes(bytes(range(256)) * 50), "unknown content; tried .*mpu6050-serial.*--map"),
        (lambda p: p.write_bytes(b"hello\n" * 50), "unknown content; tried"),
        (lambda p: p.write_bytes(b"PK\x03\x04" + bytes(100)), "damaged zip"),
    ],
)
def test_nothing_to_read(tmp_path: Path, make: Any, said: str) -> None:
    source = tmp_path / "raw"
    make(source)
    with pytest.raises(MarchaError, match=said) as caught:
        convert(source, tmp_path / "out.mcap")
    assert str(source) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert leftovers(tmp_path) == []


def test_folder_and_archive(walk: Path, tmp_path: Path) -> None:
    count = rows_of(walk)
    (walk.parent / "notes.txt").write_text("walked in the corridor\n")
    assert convert(walk.parent, tmp_path / "folder.mcap").channels[0].count == count
    archive = tmp_path / "walk.zip"
    with zipfile.ZipFile(archive, "w") as z:
        for file in walk.parent.iterdir():
            z.write(file, f"export/{file.name}")
    done = convert(archive, tmp_path / "zip.mcap")
    assert done.channels[0].count == count
    assert "/reference/pose" in {c.topic for c in done.channels}


def test_folder_of_several_recordings(walk: Path, tmp_path: Path) -> None:
    walk.with_name("conf-3333-second.csv").write_bytes(walk.read_bytes())
    with pytest.raises(MarchaError, match=r"holds 2 recordings: .*second.* one by one"):
        convert(walk.parent, tmp_path / "out.mcap")


def test_pieces_are_joined_and_strangers_are_not(walk: Path, tmp_path: Path) -> None:
    lines = walk.read_bytes().splitlines(keepends=True)
    pieces = [walk.with_name(f"conf-3333-{k}.csv") for k in "ab"]
    pieces[0].write_bytes(b"".join(lines[:1000]))
    pieces[1].write_bytes(b"".join(lines[1000:]))
    assert convert(pieces, tmp_path / "joined.mcap").channels[0].count == rows_of(walk)
    other = simulate("straight", tmp_path / "raw", format="packets").paths[0]
    with pytest.raises(MarchaError, match=r"/foot/imu1 comes from conf-3333.*one by one"):
        convert([walk, other], tmp_path / "mixed.mcap")


def test_unknown_option_and_value(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no option .colour.; it has .*conf"):
        convert(walk, tmp_path / "out.mcap", options={"colour": "red"})
    with pytest.raises(UsageError, match="truth length_m='far'"):
        convert(walk, tmp_path / "out.mcap", truth={"length_m": "far"})
    with pytest.raises(UsageError, match="option conf='9999'"):
        convert(walk, tmp_path / "out.mcap", options={"conf": "9999"})
    with pytest.raises(UsageError, match="unknown format 'fax'; one of"):
        convert(walk, tmp_path / "out.mcap", format="fax")
    with pytest.raises(UsageError, match="start='yesterday'"):
        convert(walk, tmp_path / "out.mcap", options={"start": "yesterday"})
    assert leftovers(tmp_path) == []


def test_progress_counts_messages(walk: Path, tmp_path: Path) -> None:
    seen: list[int] = []
    done = convert(walk, tmp_path / "out.mcap", progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == sum(c.count for c in done.channels)


def test_same_bytes_twice(walk: Path, tmp_path: Path) -> None:
    convert(walk, tmp_path / "a.mcap")
    convert(walk, tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


@pytest.mark.data
def test_real_recordings_convert_whole(data_dir: Path, tmp_path: Path) -> None:
    """Every file of the shoe's device: two messages a row, exit-code class as the data's README says."""
    files = sorted((data_dir / "foot" / "mpu6050").glob("conf-*.csv"))
    assert len(files) == 7
    for file in files:
        done = convert(file, tmp_path / f"{file.stem}.mcap")
        assert sum(c.count for c in done.channels) == 2 * rows_of(file)
        assert done.report.rows_dropped == done.report.rows_repaired == 0
        assert done.report.lossy == (file.name[5:9] in ("0000", "0303", "3030"))
    with pytest.raises(MarchaError, match="holds 7 recordings"):
        convert(files[0].parent, tmp_path / "all.mcap")


def test_formats_document_their_options() -> None:
    known = {f.name: f for f in known_formats()}
    assert {"mpu6050-serial", "mpu6050-packets", "table"} <= set(known)
    for info in known.values():
        assert info.title
        assert {"closed", "length_m"}.isdisjoint(o.name for o in info.options)
        assert all(o.description and o.type for o in info.options), info.name
    conf = next(o for o in known["mpu6050-serial"].options if o.name == "conf")
    assert "0–3" in conf.description


class _Twin:
    """A plug-in that takes the same text for its own."""

    name: ClassVar[str] = "twin"
    title: ClassVar[str] = "claims whatever has commas"
    Options = CommonOptions

    def sniff(self, head: bytes, path: Path) -> float:
        return 0.9 if b"," in head else 0.0

    def read(self, paths: Sequence[Path], options: Any) -> Import:
        report = ReportBuilder()

        def blocks() -> Iterator[tuple[str, pl.DataFrame]]:
            report.keep(1)
            yield "/x/y", pl.DataFrame({"t_ns": [0], "pressure_pa": [1e5]})

        spec = ChannelSpec("/x/y", "sensor_msgs/msg/FluidPressure", "", ("pressure_pa",))
        return Import(channels=[spec], blocks=blocks(), report=report)


class _Faulty(_Twin):
    name: ClassVar[str] = "faulty"

    def sniff(self, head: bytes, path: Path) -> float:
        raise ZeroDivisionError


class _Headless:
    """Lacks everything."""


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Install classes of this module as plug-ins beside the built-in importers."""
    real = registry.entry_points(group=registry.GROUP)

    def install(**points: str) -> None:
        extra = [EntryPoint(n, v, registry.GROUP) for n, v in points.items()]
        monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints([*real, *extra]))
        registry.importers.cache_clear()

    yield install
    registry.importers.cache_clear()


def test_ambiguity_lists_the_candidates(walk: Path, tmp_path: Path, plugins: Any) -> None:
    plugins(twin=f"{__name__}:_Twin")
    assert [c.name for c in recognise(walk)] == ["mpu6050-serial", "twin"]
    with pytest.raises(MarchaError, match=r"could be mpu6050-serial \(0\.95\), twin \(0\.90\); .*--format"):
        convert(walk, tmp_path / "out.mcap")
    assert convert(walk, tmp_path / "out.mcap", format="twin").channels[0].topic == "/x/y"


def test_broken_plugins_are_warnings_with_their_names(walk: Path, tmp_path: Path, plugins: Any) -> None:
    plugins(gone="nowhere.at_all:Thing", headless=f"{__name__}:_Headless", faulty=f"{__name__}:_Faulty")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert "mpu6050-serial" in importers()
        convert(walk, tmp_path / "out.mcap")
    said = " ".join(str(w.message) for w in caught)
    assert "gone (nowhere.at_all:Thing" in said
    assert "plug-in headless" in said
    assert "faulty failed to look at" in said


def test_second_of_one_name_is_left_out(plugins: Any) -> None:
    plugins(twin=f"{__name__}:_Twin", twin2=f"{__name__}:_Twin")
    with pytest.warns(UserWarning, match=r"twin2? .*left out"):
        assert "twin" in importers()
