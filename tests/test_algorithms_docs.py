"""The examples of docs/writing-an-estimator.md run and keep the contract."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from marcha.algorithms import describe, find

from .algorithms_support import FOOT
from .contracts.estimator import EstimatorContract

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/writing-an-estimator.md").read_text(encoding="utf-8")
PLAIN, KERNEL, CONTRACT = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory):
    """Return a function that makes a module of an example's text."""
    folder = tmp_path_factory.mktemp("examples")

    def load(name: str, text: str) -> ModuleType:
        path = folder / f"{name}.py"
        path.write_text(text, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec
        assert spec.loader
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module

    return load


class PageContract(EstimatorContract):
    text = PLAIN
    cls = "Tilt"

    @pytest.fixture(autouse=True)
    def _load(self, example) -> None:
        self.module = example(f"page_{self.cls.lower()}", self.text)

    def make(self):
        return getattr(self.module, self.cls)()

    def rows(self) -> np.ndarray:
        scope = vars(self.module) | {"EstimatorContract": EstimatorContract}
        exec(CONTRACT.split("\n\n\n", 1)[1], scope)
        return scope["TestTilt"]().rows()


class TestPlainExample(PageContract):
    def test_it_tells_the_angle(self) -> None:
        tilt = self.make()
        row = np.array([0.01, 0.0, 9.81 * np.sin(0.3), 9.81 * np.cos(0.3), 0.0, 0.0, 0.0])
        assert abs([tilt.step(row) for _ in range(500)][-1][0] - 0.3) < 1e-6


class TestKernelExample(PageContract):
    text = KERNEL
    cls = "Surplus"

    def rows(self) -> np.ndarray:
        return super().rows()[:, :4]


@pytest.mark.parametrize("name", FOOT)
def test_the_estimators_page_names_every_estimator_parameter_and_preset(name: str) -> None:
    page = (ROOT / "docs/estimators.md").read_text(encoding="utf-8")
    cls = find(name)
    assert f"`{name}`" in page
    missing = [p.name for p in describe(cls.Params) if f"`{p.name}`" not in page]
    missing += [preset for preset in cls.presets if f"`{preset}`" not in page]
    assert not missing
