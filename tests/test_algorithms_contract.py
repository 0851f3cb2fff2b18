"""Every built-in foot estimator keeps the contract, whatever its detector, compiled and interpreted."""

from __future__ import annotations

import os
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from marcha import algorithms
from marcha.algorithms import make
from numba.core.dispatcher import Dispatcher

from .algorithms_support import FOOT, simulated
from .contracts.estimator import RowEstimatorContract

QUICK: dict[str, Any] = {"init_s": 0.5}


class FootContract(RowEstimatorContract):
    params = QUICK

    def rows(self) -> np.ndarray:
        return simulated(rest_s=0.8)[0][:600]


class TestNaive(FootContract):
    name = "foot.naive"


class Test9Iez(FootContract):
    name = "foot.9iez"


class Test9IezFillBurst(FootContract):
    name = "foot.9iez"
    params = QUICK | {"cleaning": "fill-burst", "detector": "pitch"}


class Test9IezLive(FootContract):
    name = "foot.9iez"
    params = QUICK | {"window_side": "trailing", "cleaning": "none", "detector": "shoe"}


class Test9IezMad(FootContract):
    name = "foot.9iez-mad"


class Test9IezKf(FootContract):
    name = "foot.9iez-kf"


class Test15IezZaru(FootContract):
    name = "foot.15iez-zaru"


class TestUkf(FootContract):
    name = "foot.ukf"


INTERPRETED = """
import sys
import numpy as np
from marcha.algorithms import make
rows = np.load(sys.argv[1])
out = []
for name in sys.argv[3:]:
    estimator = make(name, init_s=0.5)
    block = np.empty((len(rows), estimator.width))
    estimator.run_block(rows, block)
    out += [block.ravel(), estimator.flush().ravel()]
np.save(sys.argv[2], np.concatenate(out))
"""


def test_interpreted_gives_the_same_bits(tmp_path: Path) -> None:
    rows = simulated(rest_s=0.8)[0][:350]
    np.save(tmp_path / "rows.npy", rows)
    subprocess.run(
        [sys.executable, "-c", INTERPRETED, str(tmp_path / "rows.npy"), str(tmp_path / "out.npy"), *FOOT],
        check=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    wanted = []
    for name in FOOT:
        estimator = make(name, **QUICK)
        block = np.empty((len(rows), estimator.width))  # type: ignore[attr-defined]
        estimator.run_block(rows, block)  # type: ignore[attr-defined]
        wanted += [block.ravel(), estimator.flush().ravel()]
    assert np.load(tmp_path / "out.npy").tobytes() == np.concatenate(wanted).tobytes()


def test_kernels_count_no_references() -> None:
    # Counting is atomic, for every array handed over and every view of a row: it doubled a sample's time.
    modules = [
        import_module(m.name) for m in pkgutil.walk_packages(algorithms.__path__, "marcha.algorithms.")
    ]
    compiled = [
        f
        for module in modules
        for f in vars(module).values()
        if isinstance(f, Dispatcher) and f.__module__ == module.__name__
    ]
    assert {"kernel", "run", "take", "emit", "update"} <= {f.__name__ for f in compiled}
    counting = {f.__name__ for f in compiled if f.targetoptions.get("_nrt", True)}
    assert not counting


@pytest.mark.parametrize("name", FOOT)
def test_a_default_run_has_no_remark_on_a_clean_walk(name: str) -> None:
    rows, _ = simulated()
    estimator = make(name)
    for row in rows:
        estimator.step(row)
    assert [r.kind for r in estimator.remarks()] == []
