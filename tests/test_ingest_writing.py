"""docs/writing-an-importer.md: its plug-in works, keeps the contract, and is found by its entry point."""

from __future__ import annotations

import re
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import ModuleType
from typing import Any

import marcha.recording as mr
import numpy as np
import pytest
from marcha.ingest import convert, known_formats, registry

from .conftest import ROOT
from .contracts.importer import ImporterContract

PAGE = (ROOT / "docs" / "writing-an-importer.md").read_text(encoding="utf-8")


def example(name: str) -> str:
    found = re.search(rf"<!-- example: {re.escape(name)} -->\n```python\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found[1]


gaitbox = ModuleType("gaitbox")
sys.modules["gaitbox"] = gaitbox  # an importable module, as an installed plug-in is
exec(compile(example("gaitbox.py"), "gaitbox.py", "exec", dont_inherit=True), gaitbox.__dict__)
_names: dict[str, Any] = {
    "ImporterContract": ImporterContract,
    "GaitBox": gaitbox.GaitBox,
    "Path": Path,
    "np": np,
    "__name__": __name__,
}
exec(compile(example("test_gaitbox.py"), "test_gaitbox.py", "exec", dont_inherit=True), _names)
TestGaitBox = _names["TestGaitBox"]


def test_found_by_its_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    point = re.search(r'\[project\.entry-points\."(.+?)"\]\n(\w+) = "(.+?)"', PAGE)
    assert point is not None
    real = registry.entry_points(group=registry.GROUP)
    extra = EntryPoint(point[2], point[3], point[1])
    assert extra.group == registry.GROUP
    monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints([*real, extra]))
    registry.importers.cache_clear()
    try:
        assert "gaitbox" in {f.name for f in known_formats()}
        source = TestGaitBox().sample(tmp_path)
        done = convert(source, tmp_path / "log.mcap", options={"side": "right"})
    finally:
        registry.importers.cache_clear()
    assert done.format == "gaitbox"
    assert [(c.topic, c.count) for c in done.channels] == [("/foot/right/imu", 500)]
    table = mr.open(tmp_path / "log.mcap").table("/foot/right/imu")
    rest = np.linalg.norm(table.head(100).select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
    assert abs(np.median(rest) / 9.80665 - 1) < 0.01
