"""Anchor tables and pictures of floors as people write them: units, degrees, decimal commas, powers that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from marcha import recording as mr
from marcha.ingest import convert
from marcha.recording.errors import MarchaError

from .radio_samples import ANCHORS, three_tables


@pytest.fixture
def log(tmp_path: Path) -> list[Path]:
    folder = three_tables(tmp_path / "walk")
    return [folder / "inertial.csv", folder / "radio.csv"]


def anchors_in(path: Path) -> pl.DataFrame:
    return pl.read_csv(mr.open(path).attachment("anchors.csv"))


def kinds(converted: object) -> set[str]:
    return {f.kind for f in converted.report.findings}  # type: ignore[attr-defined]


def test_centimetres_and_decimal_commas(log: list[Path], tmp_path: Path) -> None:
    rows = ["beacon_id;rssi_1m;eta;X (cm);Y (cm);Z (cm)"]
    rows += [
        f"{m};{p};{str(e).replace('.', ',')};{100 * x:g};{100 * y:g};{100 * z:g}"
        for m, (_, x, y, z, p, e) in ANCHORS.items()
    ]
    (tmp_path / "b.csv").write_text("\n".join(rows))
    made = convert([*log, tmp_path / "b.csv"], tmp_path / "a.mcap")
    assert {"converted_unit", "decimal_comma"} <= kinds(made)
    found = anchors_in(tmp_path / "a.mcap")
    wanted = [(x, y, z, p, e) for _, x, y, z, p, e in ANCHORS.values()]
    np.testing.assert_allclose(found.select("x", "y", "z", "p_d0", "eta").to_numpy(), wanted)


@pytest.mark.parametrize("names", ["lat,lon", "y,x"])
def test_degrees_are_laid_out_in_metres(log: list[Path], tmp_path: Path, names: str) -> None:
    narrow = np.cos(np.radians(-19.9))
    rows = [f"mac,{names},p_d0,eta"]
    rows += [
        f"{m},{-19.9 + y / 111319.49:.9f},{-43.9 + x / 111319.49 / narrow:.9f},{p},{e}"
        for m, (_, x, y, _, p, e) in ANCHORS.items()
    ]
    (tmp_path / "b.csv").write_text("\n".join(rows))
    made = convert([*log, tmp_path / "b.csv"], tmp_path / "a.mcap")
    assert "degrees" in kinds(made)
    np.testing.assert_allclose(
        anchors_in(tmp_path / "a.mcap").select("x", "y").to_numpy(),
        [(x, y) for _, x, y, *_ in ANCHORS.values()],
        atol=1e-3,
    )
    assert float(mr.open(tmp_path / "a.mcap").metadata["plan"]["x_axis_azimuth_deg"]) == 90.0


def picture(path: Path) -> Path:
    """A PNG of some size: its second byte is the one that marks C3D files."""
    from PIL import Image

    Image.fromarray(np.random.default_rng(1).integers(0, 255, (84, 250, 3), dtype=np.uint8)).save(path)
    return path


def test_degrees_beside_a_picture_are_refused(log: list[Path], tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_text("mac,lat,lon\na,-19.9,-43.9\nb,-19.9001,-43.9001\n")
    with pytest.raises(MarchaError, match=r"b\.csv: anchors in degrees.*floor\.png"):
        convert(
            [*log, tmp_path / "b.csv", picture(tmp_path / "floor.png")],
            tmp_path / "a.mcap",
            options={"plan.width_m": "25"},
        )
    assert not (tmp_path / "a.mcap").exists()


def test_a_picture_with_a_scale_is_a_plan_and_no_c3d_file(log: list[Path], tmp_path: Path) -> None:
    folder = log[0].parent
    given = [*log, folder / "anchors.csv", picture(tmp_path / "floor.png")]
    convert(given, tmp_path / "a.mcap", options={"plan.metres_per_pixel": "0.1"})
    assert b'"width_m": 25.0' in mr.open(tmp_path / "a.mcap").attachment("plan.json")


def test_a_picture_in_the_logs_own_folder_takes_the_scale_that_is_set(
    log: list[Path], tmp_path: Path
) -> None:
    folder = log[0].parent
    picture(folder / "floor.png")
    with pytest.raises(MarchaError, match=r"floor\.png.*plan\.width_m"):
        convert(folder, tmp_path / "a.mcap")
    convert(folder, tmp_path / "a.mcap", options={"plan.width_m": "25", "plan.x_axis_azimuth_deg": "74"})
    rec = mr.open(tmp_path / "a.mcap")
    assert {"anchors.csv", "plan.png", "plan.json"} <= {a.name for a in rec.attachments}
    assert rec.metadata["plan"]["x_axis_azimuth_deg"] == "74.0"


@pytest.mark.parametrize(
    ("power", "kept", "kind"), [("4", None, "bad_power"), ("59", -59.0, "repaired_sign")]
)
def test_a_transmitted_power_is_not_a_received_one(
    log: list[Path], tmp_path: Path, power: str, kept: float | None, kind: str
) -> None:
    rows = ["mac,tx power,x,y", *(f"{m},{power},{x},{y}" for m, (_, x, y, *_) in ANCHORS.items())]
    (tmp_path / "b.csv").write_text("\n".join(rows))
    assert kind in kinds(convert([*log, tmp_path / "b.csv"], tmp_path / "a.mcap"))
    assert anchors_in(tmp_path / "a.mcap")["p_d0"].to_list() == [kept] * len(ANCHORS)


def test_an_unknown_unit_of_length_is_refused(log: list[Path], tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_text("mac,x (px),y (px)\na,1,2\nb,3,4\n")
    with pytest.raises(MarchaError, match=r"b\.csv, line 1: column 'x \(px\)'.*cannot become m"):
        convert([*log, tmp_path / "b.csv"], tmp_path / "a.mcap")


def test_a_table_in_portuguese_with_floors(log: list[Path], tmp_path: Path) -> None:
    rows = ["Beacon ID;Posição X (ft);Posição Y (ft);Altura (ft);Andar"]
    rows += [
        f"{m};{x / 0.3048:.4f};{y / 0.3048:.4f};{z / 0.3048:.4f};1" for m, (_, x, y, z, *_) in ANCHORS.items()
    ]
    (tmp_path / "b.csv").write_text("\n".join(rows).replace(".", ","))
    convert([*log, tmp_path / "b.csv"], tmp_path / "a.mcap")
    found = anchors_in(tmp_path / "a.mcap").select("x", "y", "z", "floor").to_numpy()
    np.testing.assert_allclose(found, [(x, y, z, 1) for _, x, y, z, *_ in ANCHORS.values()], atol=1e-3)


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("floor.bmp", b"BM6\0\0\0", "PNG or JPEG"),
        ("b.csv", b"beacon;east of door;north of door\n02:00:00:00:00:01;1;2\n", "without x and y"),
    ],
)
def test_what_is_no_floor_says_what_it_lacks(
    log: list[Path], tmp_path: Path, name: str, content: bytes, what: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MarchaError, match=what):
        convert([*log, tmp_path / name], tmp_path / "a.mcap", options={"plan.width_m": 25})
