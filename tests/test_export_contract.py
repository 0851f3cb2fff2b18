"""Every built-in exporter keeps the contract, and a broken plug-in harms none."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import marcha.recording as mr
import pytest
from marcha.export import available, export, registry
from marcha.recording import UsageError

from .contracts.exporter import ExporterContract, example


class TestMcap(ExporterContract):
    name = "mcap"


class TestCsv(ExporterContract):
    name = "csv"


class TestParquet(ExporterContract):
    name = "parquet"


class TestRrd(ExporterContract):
    name = "rrd"


class TestBids(ExporterContract):
    name = "bids"


class TestGpx(ExporterContract):
    name = "gpx"


class TestGeoJson(ExporterContract):
    name = "geojson"


class TestKml(ExporterContract):
    name = "kml"


class TestSto(ExporterContract):
    name = "sto"


class TestMot(ExporterContract):
    name = "mot"


class TestTrc(ExporterContract):
    name = "trc"


class TestC3d(ExporterContract):
    name = "c3d"


class TestMatlab(ExporterContract):
    name = "matlab"


class TestRos2Bag(ExporterContract):
    name = "ros2bag"


class TestEvents(ExporterContract):
    name = "events"


class TestEaf(ExporterContract):
    name = "eaf"


class TestAudacity(ExporterContract):
    name = "audacity"


class TestTextGrid(ExporterContract):
    name = "textgrid"


def test_unknown_format_names_those_that_there_are(tmp_path: Path) -> None:
    rec = mr.open(example(tmp_path / "example.mcap"))
    with pytest.raises(UsageError, match=r"'xls': not known; there are .*csv, .*mcap, .*parquet, .*rrd"):
        export(rec, "xls", tmp_path / "out")


def test_a_broken_plugin_is_a_warning_with_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [EntryPoint("broken", "no.such.module:Exporter", registry.GROUP)]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    with pytest.warns(UserWarning, match="exporter plug-in broken"):
        assert available() == {}
