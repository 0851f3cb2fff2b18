"""Whole studies of short simulated walks: what is written, what is run again, and that executors agree."""

from __future__ import annotations

import csv
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import UsageError
from marcha.recording import open as open_recording
from marcha.replay import replay
from marcha.study import StudyConfig, StudyResult, gallery, plan, run_study
from marcha.study import study as study_module
from marcha.study.cells import cached
from marcha.study.config import Metric, Recordings
from marcha.study.plan import find_sources
from marcha.study.withheld import Withheld

from .phone_samples import rtk_pos, sensor_logger, short_walk

CONFIG = """
title = "Two <filters> & two sensors"
inputs = ["/foot/imu1"]

[simulate]
scenarios = ["rectangle"]
walks = 3
options = { length_m = 8.0, rest_s = 2.5 }
vary = { stride_m = [1.1, 1.3] }
configurations = { C00 = { config = "0000" }, C33 = { config = "3333" } }

[[estimators]]
name = "foot.naive"

[[estimators]]
name = "foot.9iez"
label = "9IEZ"

[[metrics]]
column = "closure_percent"
title = "EP"
unit = "%"

[[metrics]]
column = "height_end_m"
title = "EA"
unit = "m"
absolute = true

[[published]]
metric = "EP"
origin = "made up"
rows = { 9IEZ = { C33 = 1.5 } }
"""


def config(**changes: Any) -> StudyConfig:
    return msgspec.structs.replace(msgspec.toml.decode(CONFIG, type=StudyConfig), **changes)


@pytest.fixture(scope="module", autouse=True)
def fixed_code() -> Iterator[None]:
    """Keep cells' keys while somebody edits the code beside a running test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "code_digest", lambda estimators: "code")
        yield


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes longest, where it is not what is tested."""
    monkeypatch.setattr(gallery, "drawings", lambda *_: [])


@pytest.fixture
def two_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw as few figures as show that the processes draw them."""
    every = gallery.drawings
    monkeypatch.setattr(gallery, "drawings", lambda *a: every(*a)[:2])


@pytest.fixture(scope="module")
def finished(fixed_code: None, tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    return run_study(config(), tmp_path_factory.mktemp("study") / "out", workers=1)


@pytest.fixture
def copy(finished: StudyResult, tmp_path: Path) -> Path:
    """Return a copy of the finished study's folder that a test may spoil."""
    return Path(shutil.copytree(finished.folder, tmp_path / "out"))


def same_apart_from_times(one: pl.DataFrame, other: pl.DataFrame) -> bool:
    # What a run's findings say may contain the time that it took; results may not depend on where it ran.
    return one.drop("run_time_s").equals(other.drop("run_time_s"))


def test_the_folder_holds_all_that_is_promised(finished: StudyResult) -> None:
    names = {p.name for p in finished.folder.iterdir()}
    assert {
        "results.parquet",
        "results.csv",
        "report.html",
        "figures",
        "study.toml",
        "provenance.json",
    } <= names
    assert all(f.is_file() for f in finished.files)
    figures = {p.name for p in (finished.folder / "figures").iterdir()}
    assert {"tracks.png", "tracks.svg", "box-ep-both.png", "box-ep-filter.svg", "qq-ep.png"} <= figures


def test_results_have_one_row_a_cell(finished: StudyResult) -> None:
    table = pl.read_parquet(finished.folder / "results.parquet")
    assert table.height == 2 * 3 * 2
    assert table.select("recording", "filter", "input").is_unique().all()
    assert table["status"].unique().to_list() == ["ok"]
    with (finished.folder / "results.csv").open(encoding="utf-8", newline="") as file:
        assert len(list(csv.DictReader(file))) == 12


def test_a_cells_figures_are_those_of_a_replay_of_its_recording(finished: StudyResult) -> None:
    (source, *_), _ = find_sources(finished.config, None, "code")
    rec = open_recording(cached(source, finished.folder / "recordings"))
    alone = replay(rec, ["foot.9iez"], inputs=["/foot/imu1"]).runs[0].metrics
    row = finished.results.filter(pl.col("recording") == source.name, pl.col("filter") == "9IEZ").row(
        0, named=True
    )
    for name in ("closure_percent", "path_m", "height_end_m", "nees_position_end"):
        assert row[name] == alone[name]


def test_means_are_those_of_the_table(finished: StudyResult) -> None:
    values = finished.results.filter(pl.col("filter") == "9IEZ", pl.col("configuration") == "C33")[
        "closure_percent"
    ]
    group = finished.groups.filter(metric="EP", subset="all", filter="9IEZ", configuration="C33").row(
        0, named=True
    )
    assert group["n"] == 3
    assert group["mean"] == pytest.approx(values.mean())
    assert group["sd"] == pytest.approx(values.std())


def test_altitude_error_is_the_magnitude_of_the_height(finished: StudyResult) -> None:
    rows = finished.values.filter(metric="EA").sort("recording", "filter")
    heights = finished.results.sort("recording", "filter")["height_end_m"].abs()
    assert rows["value"].to_list() == heights.to_list()


def test_published_means_stand_beside_the_measured_ones(finished: StudyResult) -> None:
    row = finished.published.row(0, named=True)
    group = finished.groups.filter(metric="EP", subset="all", filter="9IEZ", configuration="C33").row(
        0, named=True
    )
    assert (row["published"], row["measured"], row["n"]) == (1.5, group["mean"], 3)


def test_clipped_inputs_are_told_apart(finished: StudyResult) -> None:
    clipped = dict(finished.results.group_by("configuration").agg(pl.col("clipped").all()).iter_rows())
    assert clipped == {"C00": True, "C33": False}
    assert set(finished.groups["subset"]) == {"all", "clipped", "unclipped"}


def test_nees_is_reported_with_its_interval_clipped_walks_apart(finished: StudyResult) -> None:
    rows = finished.consistency.filter(metric="nees_position_end", filter="9IEZ", configuration="")
    assert rows["clipped"].to_list() == [False, True]
    # chi-square quantiles with 9 degrees of freedom (Pearson and Hartley, table 8): 2.700 and 19.023.
    for row in rows.iter_rows(named=True):
        assert row["n"] == 3
        assert (row["low"] * 3, row["high"] * 3) == pytest.approx((2.700, 19.023), abs=1e-3)


def test_the_report_is_one_file_without_a_network(finished: StudyResult) -> None:
    page = (finished.folder / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', page)
    assert sources
    assert all(s.startswith(("data:image/png;base64,", "#")) for s in sources)
    assert "<script" not in page
    assert "Two &lt;filters&gt; &amp; two sensors" in page


def test_the_study_can_be_run_again_from_its_toml(finished: StudyResult) -> None:
    text = (finished.folder / "study.toml").read_bytes()
    assert msgspec.toml.decode(text, type=StudyConfig) == finished.config


def test_no_temporary_files_are_left(finished: StudyResult) -> None:
    assert not [p for p in finished.folder.rglob("*") if p.name.startswith(".")]


def test_the_json_document_holds_only_json(finished: StudyResult) -> None:
    document = msgspec.json.decode(msgspec.json.encode(finished.document))
    assert document["cells"] == 12
    assert "report.html" in document["files"]
    assert "NaN" not in msgspec.json.encode(finished.document).decode()


def no_replay(*_: Any, **__: Any) -> Any:
    raise AssertionError("a finished cell was run again")


@pytest.mark.usefixtures("no_figures")
def test_finished_cells_are_not_run_again(
    finished: StudyResult, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_module, "run_task", no_replay)
    again = run_study(config(), copy, workers=1)
    assert (again.cells_run, again.cells_reused, again.cells_failed) == (0, 12, 0)
    assert again.results.equals(finished.results)


@pytest.mark.usefixtures("no_figures")
def test_ctrl_c_keeps_the_finished_cells(tmp_path: Path) -> None:
    calls: list[float] = []

    def interrupt(done: float, total: float) -> None:
        calls.append(done)
        if done >= 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(config(), tmp_path / "out", workers=1, progress=interrupt)
    assert not (tmp_path / "out" / "results.parquet").exists()
    after = run_study(config(), tmp_path / "out", workers=1)
    assert (after.cells_run, after.cells_reused) == (8, 4)


@pytest.mark.usefixtures("no_figures")
def test_an_added_filter_runs_alone(copy: Path) -> None:
    more = config()
    more = msgspec.structs.replace(
        more,
        estimators=[
            *more.estimators,
            msgspec.structs.replace(more.estimators[1], label="x", params={"gravity": 9.8}),
        ],
    )
    again = run_study(more, copy, workers=1, resume=True)
    assert (again.cells_run, again.cells_reused) == (6, 12)


@pytest.mark.usefixtures("no_figures")
def test_another_study_is_not_overwritten(copy: Path) -> None:
    before = (copy / "results.parquet").read_bytes()
    with pytest.raises(UsageError, match="another configuration"):
        run_study(config(title="other"), copy, workers=1)
    assert (copy / "results.parquet").read_bytes() == before


def test_a_folder_of_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(UsageError, match="holds no study"):
        run_study(config(), tmp_path, workers=1, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.usefixtures("no_figures")
def test_a_damaged_cell_file_is_run_again(finished: StudyResult, copy: Path) -> None:
    victim = next((copy / "cells").iterdir())
    victim.write_bytes(victim.read_bytes()[:-7])
    again = run_study(config(), copy, workers=1)
    assert (again.cells_run, again.cells_reused) == (2, 10)
    assert same_apart_from_times(again.results, finished.results)


@pytest.mark.usefixtures("no_figures")
def test_a_recording_that_cannot_be_read_is_recorded_and_not_fatal(
    finished: StudyResult, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    good = next((finished.folder / "recordings").glob("*C33-001*"))
    shutil.copy(good, data / "good.mcap")
    (data / "bad.mcap").write_bytes(b"\x89MCAP0\r\n nothing more")
    study = config(simulate=None, published=[], recordings=Recordings())
    result = run_study(study, tmp_path / "out", data=data, workers=1)
    assert (result.cells_run, result.cells_failed) == (4, 2)
    failed = result.results.filter(status="failed")
    assert failed["recording"].unique().to_list() == ["bad"]
    assert all("bad.mcap" in e for e in failed["error"])
    assert "failed: bad" in result.notes[0]


@pytest.mark.usefixtures("no_figures")
def test_a_walk_that_an_estimator_refuses_is_recorded_and_the_others_stay(
    finished: StudyResult, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    shutil.copy(next((finished.folder / "recordings").glob("*C33-001*")), data / "good.mcap")
    raw = simulate("still", tmp_path / "raw", seed=1, duration_s=1.0, rest_s=0.5)
    convert(raw.paths, data / "short.mcap")
    study = config(simulate=None, published=[], recordings=Recordings(), estimators=config().estimators[1:])
    result = run_study(study, tmp_path / "out", data=data, workers=1)
    status = dict(result.results.select("recording", "status").iter_rows())
    assert status == {"good": "ok", "short": "failed"}


@pytest.mark.usefixtures("no_figures")
def test_truth_of_the_study_reaches_recordings_that_lack_it(finished: StudyResult, tmp_path: Path) -> None:
    data = tmp_path / "data"
    raw = simulate("rectangle", data, seed=5, length_m=8.0, name="a")
    for path in raw.truth:
        path.unlink()
    (path,) = raw.paths
    convert([path], data / "b.mcap")
    path.unlink()
    text = """
    inputs = ["/foot/imu1"]
    [recordings]
    truth = [{ closed = true, length_m = 8.0 }]
    [[estimators]]
    name = "foot.9iez"
    """
    result = run_study(msgspec.toml.decode(text, type=StudyConfig), tmp_path / "out", data=data, workers=1)
    row = result.results.row(0, named=True)
    assert row["closure_percent"] == pytest.approx(100 * row["closure_m"] / 8.0)


@pytest.mark.usefixtures("no_figures")
def test_a_survey_of_the_route_is_what_tracks_are_measured_by(fixed_code: None, tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    walk = short_walk()
    sensor_logger(data / "walk", walk)
    convert([data / "walk"], data / "walk.mcap")
    shutil.rmtree(data / "walk")
    rtk_pos(data / "route.pos", walk)
    text = """
    [recordings]
    truth = [{ survey = "route.pos" }]
    [[estimators]]
    name = "phone.fused"
    """
    config = msgspec.toml.decode(text, type=StudyConfig)
    result = run_study(config, tmp_path / "out", data=data, workers=1)
    assert result.results["recording"].to_list() == ["walk"]
    assert 0.0 <= result.results["line_median_m"][0] < 8.0
    keys = [plan.jobs(config, find_sources(config, data, "code")[0][0])[0].key]
    (data / "route.pos").write_text((data / "route.pos").read_text().replace("08:", "09:", 1) + "\n")
    keys += [plan.jobs(config, find_sources(config, data, "code")[0][0])[0].key]
    assert keys[0] != keys[1]  # another survey, another result
    (data / "route.pos").unlink()
    with pytest.raises(UsageError, match=r"route.pos: no such file; it is the survey of walk.mcap"):
        find_sources(config, data, "code")


def test_a_wrong_parameter_is_said_before_anything_runs(tmp_path: Path) -> None:
    wrong = msgspec.structs.replace(config().estimators[1], params={"sigma_speed": 1})
    with pytest.raises(UsageError, match="sigma_speed"):
        run_study(config(estimators=[wrong]), tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("two_figures")
def test_two_processes_give_the_same_results(finished: StudyResult, tmp_path: Path) -> None:
    result = run_study(config(), tmp_path / "out", workers=2)
    assert same_apart_from_times(result.results, finished.results)
    assert result.comparisons.equals(finished.comparisons)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    distributed = pytest.importorskip("dask.distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as local:
        yield local.scheduler_address


@pytest.mark.usefixtures("no_figures")
def test_a_dask_cluster_gives_the_same_results(finished: StudyResult, cluster: str, tmp_path: Path) -> None:
    result = run_study(config(), tmp_path / "out", scheduler=cluster)
    assert same_apart_from_times(result.results, finished.results)
    assert result.groups.drop("note").equals(finished.groups.drop("note"))


def test_a_scheduler_and_workers_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="either workers or a scheduler"):
        run_study(config(), tmp_path / "out", scheduler="tcp://127.0.0.1:1", workers=2)


def test_without_dask_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "dask", None)
    with pytest.raises(UsageError, match=r"marcha\[cluster\]"):
        run_study(config(), tmp_path / "out", scheduler="tcp://127.0.0.1:1")


def test_importing_the_study_loads_nothing_heavy() -> None:
    heavy = ("dask", "matplotlib", "scipy.stats", "rerun")
    code = f"import marcha.study, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout.strip() == "[]"


def test_metrics_by_label_are_compared_walk_by_walk(
    fixed_code: None, no_figures: None, tmp_path: Path
) -> None:
    by_turn = config(
        by="turn",
        published=[],
        estimators=[e for e in config().estimators if e.label == "9IEZ"],
        metrics=[Metric(column="ate_rmse_m", title="ATE", unit="m"), Metric(column="path_m", title="path")],
    )
    found = run_study(by_turn, tmp_path / "out", workers=1)
    assert set(found.labels["label"]) <= {"turn left", "turn right", "(between)"}
    assert found.labels["label"].n_unique() >= 2
    whole = found.results.select("recording", "configuration", "input", whole="path_m")
    parts = found.labels.filter(metric="path").group_by("recording", "configuration", "input")
    both = parts.agg(pl.col("value").sum()).join(whole, on=["recording", "configuration", "input"])
    assert both.height == found.results.height
    assert both["value"].to_list() == pytest.approx(both["whole"].to_list())
    pairs = found.label_comparisons.filter(metric="path", b="(between)")
    assert (pairs["difference"] < 0).all()  # less way in the turns than along the sides
    assert (tmp_path / "out" / "labels.csv").is_file()
    assert "By turn" in (tmp_path / "out" / "report.html").read_text("utf-8")


PHONES = """
[simulate]
scenarios = ["phone-100m"]
seed = 5
options = { format = "phyphox", rate_hz = 20.0, pressure_hz = 0.0, gnss_sigma_m = 4.0 }
configurations = { hand = { placement = "hand", walks = 1 }, pocket = { placement = "pocket", walks = 1 } }

[[estimators]]
name = "phone.fused"
"""


def test_a_loss_of_gps_and_the_carrying_mode_are_part_of_a_study(
    fixed_code: None, no_figures: None, tmp_path: Path
) -> None:
    """The fixes that are withheld are what the end of the loss is measured against; labels are the simulator's."""
    base = msgspec.toml.decode(PHONES, type=StudyConfig)
    loss = Withheld(topic="/phone/gnss", start_s=30.0, length_s=30.0)
    lost = msgspec.structs.replace(base, withhold=[loss], by="placement")
    found = run_study(lost, tmp_path / "lost", workers=1)
    assert found.results["status"].to_list() == ["ok", "ok"]
    assert (found.results["loss_error_m"] > 0).all()
    assert set(found.labels["label"]) >= {"hand", "pocket"}
    sources = find_sources(base, None, "code")[0]
    keys = [plan.jobs(c, sources[0])[0].key for c in (base, lost)]
    assert keys[0] != keys[1]  # a study without the loss does not take results with it
