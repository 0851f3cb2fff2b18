"""The examples of docs/writing-an-estimator.md run and keep the contract."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import Message, describe, find

from .algorithms_support import FOOT
from .contracts.estimator import EstimatorContract, messages_of

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/writing-an-estimator.md").read_text(encoding="utf-8")
PLAIN, LEG, KERNEL, CONTRACT = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


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

    def tables(self):
        scope = vars(self.module) | {"EstimatorContract": EstimatorContract}
        exec(CONTRACT, scope)
        return scope["TestTilt"]().tables()


class TestPlainExample(PageContract):
    def test_it_tells_the_angle(self) -> None:
        tilt = self.started()
        values = (0.0, 9.81 * np.sin(0.3), 9.81 * np.cos(0.3), 0.0, 0.0, 0.0)
        told = [next(iter(tilt.take(Message("imu", k * 10**7, values, k * 10**7, "/x")))) for k in range(500)]
        assert abs(told[-1].values[0] - 0.3) < 1e-6


class TestTwoSensors(PageContract):
    text = LEG
    cls = "Knee"

    def tables(self):
        def imu(every_ms: int, rate: float) -> pl.DataFrame:
            t_ns = np.arange(0, 2_000, every_ms) * 1_000_000
            return pl.DataFrame({"t_ns": t_ns, "gyr_x": np.full(len(t_ns), rate)})

        encoder_ns = np.arange(0, 2_000, 100) * 1_000_000
        encoder = pl.DataFrame({"t_ns": encoder_ns, "knee": 0.3 * encoder_ns / 1e9})
        return {
            "thigh": {"/leg/thigh/imu": imu(10, 0.5)},
            "shank": {"/leg/shank/imu": imu(7, 0.2)},
            "encoder": {"/leg/encoder": encoder},
        }

    def test_it_follows_both_rates(self) -> None:
        knee = self.started()
        last = [
            r for m in messages_of(knee, self.tables()) for r in knee.take(m) or () if r.output == "joint"
        ][-1]
        assert abs(last.values[0] - 0.3 * 1.99) < 0.01


class TestKernelExample(PageContract):
    text = KERNEL
    cls = "Surplus"


@pytest.mark.parametrize("name", FOOT)
def test_the_estimators_page_names_every_estimator_parameter_and_preset(name: str) -> None:
    page = (ROOT / "docs/estimators.md").read_text(encoding="utf-8")
    cls = find(name)
    assert f"`{name}`" in page
    missing = [p.name for p in describe(cls.Params) if f"`{p.name}`" not in page]
    missing += [preset for preset in cls.presets if f"`{preset}`" not in page]
    assert not missing
