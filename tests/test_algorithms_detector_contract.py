"""Every built-in detector keeps the detectors' contract."""

from __future__ import annotations

from typing import Any, ClassVar

from marcha.algorithms.foot.detectors import BY_NAME

from .contracts.detector import DetectorContract


class TestC1C2C3(DetectorContract):
    name = "c1c2c3"


class TestPitch(DetectorContract):
    name = "pitch"


class TestShoe(DetectorContract):
    name = "shoe"
    params: ClassVar[dict[str, Any]] = {"shoe_max": 1e5}


class TestAre(DetectorContract):
    name = "are"
    params: ClassVar[dict[str, Any]] = {"are_max": 0.3}


class TestMv(DetectorContract):
    name = "mv"
    params: ClassVar[dict[str, Any]] = {"mv_max": 0.3, "window_s": 0.15}


class TestMag(DetectorContract):
    name = "mag"
    params: ClassVar[dict[str, Any]] = {"mag_max": 0.4, "window_s": 0.15}


class TestGait(DetectorContract):
    name = "gait"


def test_none_is_left_out() -> None:
    assert {c.name for c in DetectorContract.__subclasses__()} == set(BY_NAME)
