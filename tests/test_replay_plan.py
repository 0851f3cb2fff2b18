"""What will run: names, parameters, channels."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np
import pytest
from marcha.algorithms import Input, Output, RowEstimator
from marcha.recording import UsageError
from marcha.replay import EstimatorSpec, parse_estimator, plan_runs

from .replay_helpers import ACC, IMU, MAG, VALUES, Echo, MemorySource, channel, imu_table, table

MAG_COLUMNS = ("mag_x", "mag_y")
GYR = ("gyr_x", "gyr_y", "gyr_z")


def source(*channels: tuple[str, str, tuple[str, ...]]) -> MemorySource:
    tables = []
    for topic, schema, columns in channels:
        tables.append((channel(topic, schema, columns), table([0, 10], {c: [1.0, 2.0] for c in columns})))
    return MemorySource(tables)


def two_imus() -> MemorySource:
    return source(("/foot/imu1", IMU, ACC), ("/foot/imu2", IMU, ACC))


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("foot.9iez", EstimatorSpec("foot.9iez")),
        ("foot.9iez[]", EstimatorSpec("foot.9iez")),
        ("foot.9iez[sigma_acc=0.01]", EstimatorSpec("foot.9iez", {"sigma_acc": 0.01})),
        ("slow=foot.9iez[a=1, b=true]", EstimatorSpec("foot.9iez", {"a": 1, "b": True}, "slow")),
        (
            "x[list=[1,2],word=shoe,none=null]",
            EstimatorSpec("x", {"list": [1, 2], "word": "shoe", "none": None}),
        ),
        ('x[text="a,b"]', EstimatorSpec("x", {"text": "a,b"})),
        ("my-label=x", EstimatorSpec("x", {}, "my-label")),
    ],
)
def test_parse(text: str, spec: EstimatorSpec) -> None:
    assert parse_estimator(text) == spec


@pytest.mark.parametrize("text", ["", "x[", "x]", "x[a]", "x[=1]", "a b", "x[a=1,a=2]", "=x"])
def test_parse_refuses_in_one_line(text: str) -> None:
    with pytest.raises(UsageError) as error:
        parse_estimator(text)
    assert "\n" not in str(error.value)


def ids(*estimators: Any, **options: Any) -> list[str]:
    return [r.run for r in plan_runs(two_imus(), estimators, **options)]


def test_ids_name_estimator_and_input() -> None:
    assert ids(Echo()) == ["echo_foot_imu1", "echo_foot_imu2"]


def test_the_same_estimator_twice_gets_a_number() -> None:
    assert ids(Echo(), Echo(), inputs=["/foot/imu2"]) == ["echo_foot_imu2", "echo_foot_imu2_2"]


def test_a_taken_id_gets_a_number_and_says_so() -> None:
    (run,) = plan_runs(two_imus(), [Echo()], inputs=["/foot/imu1"], taken=["echo_foot_imu1"])
    assert run.run == "echo_foot_imu1_2"
    assert [f.kind for f in run.findings] == ["renamed_run"]


def test_runs_never_share_an_instance() -> None:
    mine = Echo()
    a, b = plan_runs(two_imus(), [mine])
    assert len({id(a.estimator), id(b.estimator), id(mine)}) == 3


class Tunable(RowEstimator):
    class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        gain: Annotated[float, msgspec.Meta(gt=0)] = 1.0
        rate_hz: float = 0.0

    name = "tunable"
    inputs = (Input("imu", IMU, ACC),)
    outputs = (Output("v", VALUES, ("v",)),)

    def step(self, row: np.ndarray) -> np.ndarray:
        return row[:1]


def test_params_go_to_whoever_has_them() -> None:
    runs = plan_runs(two_imus(), [Tunable, Echo()], {"gain": 2.5}, inputs=["/foot/imu1"])
    assert [r.params for r in runs] == [{"gain": 2.5, "rate_hz": 100.0}, {}]


def test_params_that_nobody_has_are_refused() -> None:
    with pytest.raises(UsageError, match="gian"):
        plan_runs(two_imus(), [Tunable], {"gian": 2.5})


def test_params_out_of_range_are_refused() -> None:
    with pytest.raises(UsageError, match="gain"):
        plan_runs(two_imus(), [Tunable], {"gain": -1.0})


def test_the_measured_rate_fills_a_rate_that_is_not_set() -> None:
    assert plan_runs(two_imus(), [Tunable])[0].params["rate_hz"] == 100.0
    assert plan_runs(two_imus(), [Tunable(Tunable.Params())])[0].params["rate_hz"] == 100.0


def test_a_rate_that_is_set_stays() -> None:
    assert plan_runs(two_imus(), [Tunable], {"rate_hz": 42.0})[0].params["rate_hz"] == 42.0


def test_a_registered_name_takes_brackets_over_common_parameters() -> None:
    imu = MemorySource(
        [(channel("/foot/imu", IMU, (*ACC, *GYR)), imu_table(3).with_columns(**dict.fromkeys(GYR, 0.0)))]
    )
    runs = plan_runs(imu, ["foot.9iez", "loud=foot.9iez[sigma_acc=0.5]"], {"sigma_acc": 0.2})
    assert [r.params["sigma_acc"] for r in runs] == [0.2, 0.5]
    assert [r.run for r in runs] == ["foot_9iez_foot_imu", "loud_foot_imu"]
    assert runs[0].version.startswith("marcha ")


@pytest.mark.parametrize(
    ("estimator", "said"),
    [("foot.nine", "foot.9iez"), ("foot.9iez[sigma=1]", "sigma_acc"), ("foot.9iez[preset=none]", "preset")],
)
def test_unknown_names_list_what_there_is(estimator: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        plan_runs(two_imus(), [estimator])


def test_no_estimator_is_refused() -> None:
    with pytest.raises(UsageError, match="no estimator"):
        plan_runs(two_imus(), [])


# -- channels ------------------------------------------------------------------------------------------------


def test_references_and_estimates_are_not_taken_unless_named() -> None:
    several = source(("/foot/imu", IMU, ACC), ("/reference/imu", IMU, ACC), ("/estimate/a/imu", IMU, ACC))
    assert [r.input for r in plan_runs(several, [Echo()])] == ["/foot/imu"]
    assert [r.input for r in plan_runs(several, [Echo()], inputs=["/estimate/a/imu"])] == ["/estimate/a/imu"]


def test_an_unknown_topic_is_refused_with_those_that_exist() -> None:
    with pytest.raises(UsageError, match="/foot/imu1"):
        plan_runs(two_imus(), [Echo()], inputs=["/foot/imu9"])


def test_no_channel_of_the_kind_names_the_kind() -> None:
    with pytest.raises(UsageError, match="sensor_msgs/msg/Imu"):
        plan_runs(source(("/foot/mag", MAG, MAG_COLUMNS)), [Echo()])


def test_a_missing_gyroscope_is_named() -> None:
    with pytest.raises(UsageError, match="/foot/imu1 has no column gyr_x"):
        plan_runs(two_imus(), [Echo(columns=(*ACC, *GYR))])


WITH_MAG = Echo(further=[Input("mag", MAG, MAG_COLUMNS, optional=True)])
NEEDS_MAG = Echo(further=[Input("mag", MAG, MAG_COLUMNS)])


def test_a_further_input_is_the_one_beside_the_first() -> None:
    feet = source(
        ("/left/imu", IMU, ACC),
        ("/left/mag", MAG, MAG_COLUMNS),
        ("/right/imu", IMU, ACC),
        ("/right/mag", MAG, MAG_COLUMNS),
    )
    assert [[t for t, _ in r.row_inputs] for r in plan_runs(feet, [NEEDS_MAG])] == [
        ["/left/imu", "/left/mag"],
        ["/right/imu", "/right/mag"],
    ]


def test_an_optional_input_that_is_not_there_is_none() -> None:
    (run,) = plan_runs(source(("/foot/imu", IMU, ACC)), [WITH_MAG])
    assert [t for t, _ in run.row_inputs] == ["/foot/imu", None]
    assert run.findings == ()


def test_an_ambiguous_optional_input_is_left_out_and_said() -> None:
    two = source(("/foot/imu", IMU, ACC), ("/foot/mag1", MAG, MAG_COLUMNS), ("/foot/mag2", MAG, MAG_COLUMNS))
    (run,) = plan_runs(two, [WITH_MAG])
    assert run.row_inputs[1][0] is None
    assert [f.kind for f in run.findings] == ["ambiguous_input"]


def test_a_named_further_input_is_taken() -> None:
    two = source(("/foot/imu", IMU, ACC), ("/foot/mag1", MAG, MAG_COLUMNS), ("/foot/mag2", MAG, MAG_COLUMNS))
    (run,) = plan_runs(two, [WITH_MAG], inputs=["/foot/imu", "/foot/mag2"])
    assert run.row_inputs[1][0] == "/foot/mag2"


def test_a_required_input_that_is_not_there_is_refused() -> None:
    with pytest.raises(UsageError, match="MagneticField"):
        plan_runs(source(("/foot/imu", IMU, ACC), ("/hand/mag", MAG, MAG_COLUMNS)), [NEEDS_MAG])


class Pair(Echo):
    name = "pair"

    def __init__(self) -> None:
        super().__init__()
        self.inputs = (Input("a", IMU, ACC), Input("b", IMU, ACC))
        self.outputs = (Output("d", VALUES, ("d",)),)


def test_a_pair_of_sensors_is_one_run_in_the_order_named() -> None:
    (run,) = plan_runs(two_imus(), [Pair()], inputs=["/foot/imu2", "/foot/imu1"])
    assert [t for t, _ in run.row_inputs] == ["/foot/imu2", "/foot/imu1"]


def test_a_pair_among_three_must_be_named() -> None:
    three = source(("/x/imu", IMU, ACC), ("/y/imu", IMU, ACC), ("/z/imu", IMU, ACC))
    with pytest.raises(UsageError, match="name them with --input a=TOPIC"):
        plan_runs(three, [Pair()])


def test_topics_that_have_the_inputs_names_are_theirs() -> None:
    legs = source(("/leg/c/imu", IMU, ACC), ("/leg/b/imu", IMU, ACC), ("/leg/a/imu", IMU, ACC))
    (run,) = plan_runs(legs, [Pair()])
    assert run.topics == {"a": ("/leg/a/imu",), "b": ("/leg/b/imu",)}


def test_roles_are_named_by_the_user() -> None:
    (run,) = plan_runs(two_imus(), [Pair()], inputs=["b=/foot/imu1", "a=/foot/imu2"])
    assert run.topics == {"a": ("/foot/imu2",), "b": ("/foot/imu1",)}


def test_the_partner_of_a_named_channel_is_another_one() -> None:
    (run,) = plan_runs(two_imus(), [Pair()], inputs=["a=/foot/imu1"])
    assert run.topics == {"a": ("/foot/imu1",), "b": ("/foot/imu2",)}
    three = source(("/x/imu", IMU, ACC), ("/y/imu", IMU, ACC), ("/z/imu", IMU, ACC))
    with pytest.raises(UsageError, match=r"/y/imu, /z/imu; name it with --input b=TOPIC"):
        plan_runs(three, [Pair()], inputs=["a=/x/imu"])
    with pytest.raises(UsageError, match="no other"):
        plan_runs(source(("/x/imu", IMU, ACC)), [Pair()], inputs=["a=/x/imu"])


def test_the_partner_of_a_named_channel_is_of_its_side() -> None:
    legs = source(*((f"/leg/{s}_{i}/imu", IMU, ACC) for s in ("left", "right") for i in "ab"))
    (run,) = plan_runs(legs, [Pair()], inputs=["a=/leg/right_a/imu"])
    assert run.topics == {"a": ("/leg/right_a/imu",), "b": ("/leg/right_b/imu",)}


def test_a_choice_by_order_is_said() -> None:
    (run,) = plan_runs(two_imus(), [Pair()])
    assert [f.kind for f in run.findings] == ["attached_by_order"]


def test_a_role_that_nobody_has_is_refused() -> None:
    with pytest.raises(UsageError, match="thigh"):
        plan_runs(two_imus(), [Pair()], inputs=["thigh=/foot/imu1"])


def test_outputs_become_topics_with_their_origin() -> None:
    (run, _) = plan_runs(two_imus(), [Tunable])
    (planned,) = run.outputs.values()
    assert planned.topic == "/estimate/tunable_foot_imu1/v"
    assert planned.metadata["input"] == "/foot/imu1"
    assert planned.metadata["estimator"] == "tunable"
    assert planned.run == run.run
