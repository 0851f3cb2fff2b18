"""What every zero-velocity detector promises; subclass it with its name."""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest
from marcha.algorithms import describe, make
from marcha.algorithms.foot.detectors import BY_NAME

from ..algorithms_support import columns, run, simulated


class DetectorContract:
    """Inherit and set ``name`` (and ``params`` where the defaults do not suit the simulated walk)."""

    name: ClassVar[str]
    params: ClassVar[dict[str, Any]] = {}

    def options(self, **more: Any) -> dict[str, Any]:
        """Return parameters of ``foot.naive`` with this detector."""
        return {"detector": self.name, "init_s": 0.5, **self.params, **more}

    def test_says_what_it_is(self) -> None:
        cls = BY_NAME[self.name]
        assert cls.name == self.name
        assert cls.title
        assert cls.source
        assert cls.__doc__
        assert 1 <= len(cls.statistics) <= 3
        own = {p.name for p in describe(cls.Params)}
        others = {f for d in BY_NAME.values() if d is not cls for f in d.Params.__struct_fields__}
        assert own
        assert not own & others
        for parameter in describe(cls.Params):
            assert parameter.effect

    def test_its_limits_belong_to_its_statistics(self) -> None:
        estimator = make("foot.naive", **self.options())
        cls = BY_NAME[self.name]
        limits = cls.limits(estimator.params)
        assert {k.removesuffix(".min") for k in limits} <= set(cls.statistics)
        output = next(o for o in estimator.outputs if o.name == "detector")
        assert output.columns == cls.statistics
        assert {k.removeprefix("threshold.") for k, _ in output.metadata if "." in k} >= set(limits)

    def test_every_parameter_changes_the_record(self) -> None:
        plain = make("foot.naive", **self.options()).record.detector  # type: ignore[attr-defined]
        for name in BY_NAME[self.name].Params.__struct_fields__:
            value = getattr(make("foot.naive", **self.options()).params, name)
            if not isinstance(value, float):
                continue
            changed = make("foot.naive", **self.options(**{name: value * 1.01 + 1e-9}))
            assert changed.record.detector.tobytes() != plain.tobytes(), name  # type: ignore[attr-defined]

    @pytest.mark.parametrize("side", ["centred", "trailing"])
    def test_latency_is_all_that_it_looks_ahead(self, side: str) -> None:
        """What comes more than the latency later cannot change a decision or a statistic."""
        rows, _ = simulated(rest_s=0.8)
        rows = rows[:500]
        options = self.options(window_side=side)
        whole, estimator = run("foot.naive", rows, **options)
        changed = rows.copy()
        changed[400:, 1:] += np.random.default_rng(1).normal(0, 20, (100, 6))
        other, _ = run("foot.naive", changed, **options)
        known = 400 - estimator.latency
        for output in ("stance", "detector"):
            a, b = columns(whole, output), columns(other, output)
            np.testing.assert_array_equal(a[:known], b[:known])
            assert not np.array_equal(a[known:], b[known:], equal_nan=True)

    def test_snapshot_restore_and_single_rows_give_the_same_bits(self) -> None:
        rows, _ = simulated(rest_s=0.8)
        rows = rows[:500]
        whole, _ = run("foot.naive", rows, **self.options())
        estimator: Any = make("foot.naive", **self.options())
        block = np.empty((250, estimator.width))
        estimator.run_block(rows[:250], block)
        kept = estimator.snapshot()
        estimator.run_block(rows[100:400], np.empty((300, estimator.width)))
        estimator.restore(kept)
        later = [r for r in (estimator.step(row) for row in rows[250:]) if r is not None]
        got = np.vstack([block[estimator.latency :], *later, estimator.flush()])
        assert got.tobytes() == np.column_stack(list(whole.values())).tobytes()

    def test_finds_stances_of_a_walk(self) -> None:
        rows, walk = simulated(strike_mm=0.3)
        result, _ = run("foot.naive", rows, **{"detector": self.name, **self.params})
        still = result["stance.still"] == 1
        assert (still == walk.still)[200:].mean() > 0.85
        starts = np.flatnonzero(np.diff(still[200:].astype(int)) == 1)
        assert abs(len(starts) - walk.steps.height) <= 2

    def test_parameters_are_a_struct(self) -> None:
        assert issubclass(BY_NAME[self.name].Params, msgspec.Struct)
