"""Finding estimators and building them with checked parameters."""

from __future__ import annotations

import warnings
from importlib.metadata import EntryPoint
from typing import Annotated

import msgspec
import numpy as np
import pytest
from marcha.algorithms import AlgorithmError, available, describe, find, make, parameters, registry

from .algorithms_support import FOOT


class Plugin:
    """A plug-in that is nothing but a class with step."""

    name = "my.plugin"

    def step(self, row: np.ndarray) -> np.ndarray | None:
        return row


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch):
    """Return a function that says which entry points are installed."""

    def install(**points: str) -> None:
        found = [EntryPoint(k.replace("__", "."), v, registry.GROUP) for k, v in points.items()]
        monkeypatch.setattr(registry, "entry_points", lambda group: found)

    return install


@pytest.mark.parametrize("name", FOOT)
def test_built_in_estimators_are_found_by_name(name: str) -> None:
    assert find(name).name == name
    assert make(name).name == name


def test_available_holds_the_built_in_ones() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert set(FOOT) <= set(available())


def test_a_plugin_is_found(installed) -> None:
    installed(my__plugin="tests.test_algorithms_registry:Plugin")
    assert list(available()) == ["my.plugin"]


@pytest.mark.parametrize(
    "value",
    ["no.such.module:Thing", "tests.test_algorithms_registry:Missing", "tests.test_algorithms_registry:FOOT"],
)
def test_a_broken_plugin_is_a_warning_with_its_name(installed, value: str) -> None:
    installed(good="tests.test_algorithms_registry:Plugin", broken=value)
    with pytest.warns(UserWarning, match="'broken'"):
        assert list(available()) == ["good"]
    with (
        pytest.warns(UserWarning, match="'broken'"),
        pytest.raises(AlgorithmError, match=r"cannot be loaded.*good"),
    ):
        find("broken")


def one_line(name: str, **params) -> str:
    with pytest.raises(AlgorithmError) as error:
        make(name, **params)
    text = str(error.value)
    assert "\n" not in text
    return text


def test_unknown_name_lists_what_there_is() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert "foot.9iez, " in one_line("foot.9ieZ")


def test_unknown_parameter_lists_what_there_is() -> None:
    assert "sigma_acc, sigma_baro, sigma_gyr" in one_line("foot.9iez", sigma=1)


def test_unknown_preset_lists_what_there_is() -> None:
    assert "shoe-tuned" in one_line("foot.9iez", preset="best")


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"sigma_acc": -1}, "sigma_acc = -1 is not allowed; must be float ≥ 0 (m/s²)"),
        ({"detector": "zupt"}, "are, c1c2c3, gait, mag, mv, pitch, shoe"),
        ({"gravity": "much"}, "gravity = 'much'"),
        ({"gravity": float("nan")}, "gravity = nan"),
        ({"c3_max": float("inf")}, "c3_max = inf"),
        ({"c1_min": 12}, "c1_min = 12 must be below c1_max = 11"),
        ({"rate_hz": 1e9}, "rate_hz"),
    ],
)
def test_a_value_out_of_range_names_the_rule(params: dict, said: str) -> None:
    assert said in one_line("foot.9iez", **params)


def test_text_is_converted_as_a_command_line_needs() -> None:
    params = make("foot.9iez", sigma_acc="0.2", gravity_from_rest="true", detector="shoe").params
    assert (params.sigma_acc, params.gravity_from_rest, params.detector) == (0.2, True, "shoe")  # type: ignore[attr-defined]


def test_parameters_go_on_top_of_a_preset() -> None:
    params = make("foot.9iez", preset="shoe-tuned", shoe_max=7e4).params
    assert (params.detector, params.shoe_max) == ("shoe", 7e4)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", FOOT)
def test_every_parameter_has_effect_and_unit(name: str) -> None:
    for p in describe(find(name).Params):
        assert p.effect, p.name
        assert p.unit, p.name
        assert p.default is not None, p.name
        if p.name.startswith(("sigma", "c1", "c2", "c3", "shoe", "are", "pitch")):
            assert p.source, p.name


def test_describe_tells_type_range_and_choices() -> None:
    class Params(msgspec.Struct):
        gain: Annotated[float, parameters.meta("How much", "m", "ours", ge=0, lt=2)] = 1.0
        plain: int = 3

    gain, plain = describe(Params)
    assert (gain.type, gain.default, gain.unit, gain.range) == ("float", 1.0, "m", "≥ 0, < 2")
    assert (plain.type, plain.default, plain.effect) == ("int", 3, "")
    detector = next(p for p in describe(find("foot.9iez").Params) if p.name == "detector")
    assert "shoe" in detector.choices
