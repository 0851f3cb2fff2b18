"""Estimators of several inputs: every message once, in order, the same bits however they come; chains."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import Any

import numba
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marcha.algorithms import (
    Annotate,
    Context,
    Input,
    KernelEstimator,
    Message,
    Output,
    PlainEstimator,
    Remark,
    Result,
)
from marcha.algorithms.numerics.compiled import compiled
from marcha.recording import MarchaError, UsageError
from marcha.replay import Engine, GapPolicy, LiveSource, TableSink, plan_runs, replay

from .event_loop import drive
from .replay_helpers import ACC, IMU, STEP_NS, VALUES, MemorySource, channel, run_all, same_bits, table

MS = 1_000_000
RADIO = "marcha_msgs/msg/RadioSignal"
JOINT = "sensor_msgs/msg/JointState"
POINT = "geometry_msgs/msg/PointStamped"
BEACONS = [f"c4:ac:59:00:00:{i:02x}" for i in range(5)]


class Scans(PlainEstimator):
    """Says what it heard, and how many of each."""

    name = "scans"
    inputs = (Input("radio", RADIO, ("mac", "rssi_dbm"), many=True),)
    outputs = (
        Output("heard", "rcl_interfaces/msg/Text", ("mac", "rssi")),
        Output("count", VALUES, ("n",), event=True),
    )

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self.heard: dict[str, int] = {}

    def take(self, message: Message) -> Iterable[Result]:
        mac, rssi = message.values
        self.heard[mac] = self.heard.get(mac, 0) + 1
        yield Result("heard", message.t_ns, (mac, rssi))
        if self.heard[mac] % 4 == 0:
            yield Result("count", message.t_ns, (float(self.heard[mac]),))


def scan_table(times: Iterable[int]) -> pl.DataFrame:
    rows = [(t * MS, t * MS, mac, -60.0 - i) for t in times for i, mac in enumerate(BEACONS)]
    return pl.DataFrame(rows, schema=["t_ns", "t_log_ns", "mac", "rssi_dbm"], orient="row")


def test_every_message_of_a_scan_arrives_with_its_address() -> None:
    source = MemorySource([(channel("/phone/radio", RADIO, ("mac", "rssi_dbm")), scan_table(range(10)))], 7)
    result, tables = run_all(source, [Scans()])
    heard = tables["/estimate/scans_phone_radio/heard"]
    assert heard.height == 50
    assert heard["mac"].to_list() == BEACONS * 10
    assert result.runs[0].samples == 50
    assert result.runs[0].findings == []


class LegKernel(KernelEstimator):
    """Two IMUs and an encoder at three rates; its bits depend on every message and their order."""

    name = "leg"
    inputs = (
        Input("thigh", IMU, ACC, regular=True),
        Input("shank", IMU, ACC, regular=True),
        Input("encoder", JOINT, ("knee",), optional=True),
    )
    outputs = (Output("state", VALUES, ("angle", "dt")), Output("corrected", VALUES, ("by",), event=True))
    dtype = np.dtype([("angle", "f8"), ("last_ns", "i8"), ("n", "i8")])

    def start(self, context: Context) -> None:
        super().start(context)
        self.state = np.zeros(1, self.dtype)

    def remarks(self) -> list[Remark]:
        return []


@compiled
def _run(
    state: Any, inputs: Any, channels: Any, t_ns: Any, values: Any, out_message: Any, out_t_ns: Any, out: Any
) -> int:
    s = state[0]
    n = 0
    for i in range(len(inputs)):
        dt = (t_ns[i] - s.last_ns) / 1e9 if s.n > 0 else 0.0
        s.last_ns = t_ns[i]
        s.n += 1
        if inputs[i] == 2:
            by = 0.1 * (values[i, 0] - s.angle)
            s.angle += by
            out[n, 2] = by
        else:
            sign = 1.0 if inputs[i] == 0 else -1.0
            s.angle = 0.97 * s.angle + sign * np.sin(values[i, 0]) * (dt + 0.01) / 3.0 + values[i, 2] / 7.0
            out[n, 2] = np.nan
        out[n, 0] = s.angle
        out[n, 1] = dt
        out_message[n] = i
        out_t_ns[n] = t_ns[i]
        n += 1
    return n


LegKernel.run = staticmethod(_run)


class LegPlain(PlainEstimator):
    """The same in plain Python."""

    name = "leg"
    inputs = LegKernel.inputs
    outputs = LegKernel.outputs

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self.angle, self.last_ns, self.n = 0.0, 0, 0

    def take(self, message: Message) -> list[Result]:
        dt = (message.t_ns - self.last_ns) / 1e9 if self.n else 0.0
        self.last_ns, self.n = message.t_ns, self.n + 1
        found = []
        if message.input == "encoder":
            by = 0.1 * (message.values[0] - self.angle)
            self.angle += by
            found.append(Result("corrected", message.t_ns, (by,)))
        else:
            sign = 1.0 if message.input == "thigh" else -1.0
            x, _, z = message.values
            self.angle = 0.97 * self.angle + sign * float(np.sin(x)) * (dt + 0.01) / 3.0 + z / 7.0
        return [Result("state", message.t_ns, (self.angle, dt)), *found]


number = st.sampled_from([0.0, 1.5, -2.0, 0.3])
gappy = st.sampled_from([0.0, 1.5, -2.0, float("nan")])


def messages(columns: tuple[str, ...], values: Any, size: int = 25) -> st.SearchStrategy[pl.DataFrame]:
    """Tables with ties, repeated and backward times, late arrivals."""
    row = st.tuples(st.integers(-1, 4), st.integers(0, 3), *[values] * len(columns))

    def build(rows: list[tuple]) -> pl.DataFrame:
        t = 10**9 + np.cumsum([r[0] for r in rows], dtype=np.int64) * MS if rows else np.empty(0, np.int64)
        log = np.maximum.accumulate(t + np.array([r[1] for r in rows], np.int64) * MS) if rows else t
        frame = table(t.tolist(), {c: [r[2 + i] for r in rows] for i, c in enumerate(columns)}, log.tolist())
        return frame.cast(dict.fromkeys(columns, pl.Float64))

    return st.lists(row, min_size=1, max_size=size).map(build)


def leg_source(
    thigh: pl.DataFrame, shank: pl.DataFrame, encoder: pl.DataFrame, max_rows: int
) -> MemorySource:
    return MemorySource(
        [
            (channel("/leg/thigh/imu", IMU, ACC), thigh),
            (channel("/leg/shank/imu", IMU, ACC), shank),
            (channel("/leg/encoder", JOINT, ("knee",)), encoder),
        ],
        max_rows,
    )


LEGS: dict[str, Any] = {
    "thigh": messages(ACC, gappy),
    "shank": messages(ACC, gappy),
    "encoder": messages(("knee",), number),
    "max_rows": st.integers(1, 60),
}


def as_rows(tables: dict[str, pl.DataFrame], run: str, outputs: Iterable[str]) -> dict[str, list[tuple]]:
    return {o: tables[f"/estimate/{run}/{o}"].rows() for o in outputs}


@settings(max_examples=100)
@given(**LEGS)
def test_three_rates_equal_a_plain_event_loop(
    thigh: pl.DataFrame, shank: pl.DataFrame, encoder: pl.DataFrame, max_rows: int
) -> None:
    source = leg_source(thigh, shank, encoder, max_rows)
    wide = GapPolicy(max_gap_s=10.0)
    inputs = {
        "thigh": {"/leg/thigh/imu": thigh},
        "shank": {"/leg/shank/imu": shank},
        "encoder": {"/leg/encoder": encoder},
    }
    expected = {name: t.rows() for name, t in drive(LegPlain(), inputs).items()}
    for estimator in (LegPlain(), LegKernel()):
        for mode in ("block", "sample"):
            _, tables = run_all(source, [estimator], gap=wide, mode=mode)
            assert as_rows(tables, "leg_leg_thigh_imu", expected) == expected


@settings(max_examples=40)
@given(
    **LEGS,
    seeks=st.lists(st.integers(0, 60), max_size=4),
    policy=st.sampled_from(["bridge", "reset", "stop"]),
)
def test_seeks_and_cuts_change_no_bit(
    thigh: pl.DataFrame,
    shank: pl.DataFrame,
    encoder: pl.DataFrame,
    max_rows: int,
    seeks: list[int],
    policy: Any,
) -> None:
    gap = GapPolicy(policy, 0.0035)
    whole, wanted = run_all(leg_source(thigh, shank, encoder, 1000), [LegKernel()], gap=gap)
    source, sink = leg_source(thigh, shank, encoder, max_rows), TableSink()
    engine = Engine(source, plan_runs(source, [LegKernel()]), sinks=[sink], gap=gap, checkpoint_s=0.004)
    for at in seeks:
        engine.seek(10**9 + at * MS)
    engine.play()
    result = engine.finish()
    got = {t: sink.table(t) for t in wanted}
    assert same_bits(got, wanted)  # type: ignore[arg-type]
    assert [f.kind for f in result.runs[0].findings] == [f.kind for f in whole.runs[0].findings]
    assert result.runs[0].samples == whole.runs[0].samples


def test_a_gap_of_one_input_starts_the_estimator_anew() -> None:
    thigh = table([0, MS, 900 * MS, 901 * MS], {c: [1.0] * 4 for c in ACC})
    shank = table([k * MS for k in range(902)], {c: [0.5] * 902 for c in ACC})
    source = leg_source(thigh, shank, table([0], {"knee": [0.0]}), 1000)
    result, tables = run_all(source, [LegPlain()], gap={"thigh": GapPolicy("reset", 0.1)})
    state = tables["/estimate/leg_leg_thigh_imu/state"]
    restarts = state.filter((pl.col("dt") == 0.0) & (pl.col("t_ns") > 100 * MS))
    assert restarts["t_ns"].to_list()[0] == 900 * MS
    assert result.runs[0].segments == 2


def test_stop_ends_every_input_at_the_gap() -> None:
    thigh = table([0, MS, 900 * MS, 901 * MS], {c: [1.0] * 4 for c in ACC})
    shank = table([k * MS for k in range(902)], {c: [0.5] * 902 for c in ACC})
    for max_rows in (1000, 1):
        source = leg_source(thigh, shank, table([0], {"knee": [0.0]}), max_rows)
        _, tables = run_all(source, [LegPlain()], gap={"thigh": GapPolicy("stop", 0.1)})
        assert tables["/estimate/leg_leg_thigh_imu/state"]["t_ns"].max() == 899 * MS


def test_a_missing_optional_input_is_left_out() -> None:
    imu = table([0, STEP_NS], {c: [1.0, 2.0] for c in ACC})
    source = MemorySource(
        [(channel("/a/thigh/imu", IMU, ACC), imu), (channel("/a/shank/imu", IMU, ACC), imu)]
    )
    result, _ = run_all(source, [LegPlain()])
    assert result.runs[0].inputs == {"thigh": ("/a/thigh/imu",), "shank": ("/a/shank/imu",), "encoder": ()}
    assert result.runs[0].samples == 4


def test_live_messages_give_the_same_results() -> None:
    source = MemorySource([(channel("/phone/radio", RADIO, ("mac", "rssi_dbm")), scan_table(range(10)))])
    _, wanted = run_all(source, [Scans()])
    heard = scan_table(range(10)).select("t_ns", "mac", "rssi_dbm").rows()
    live = LiveSource(list(source.channels.values()), (("/phone/radio", t, v) for t, *v in heard))
    run = replay(live, [Scans()]).runs[0]
    assert {f"/estimate/{run.run}/{n}": t.rows() for n, t in run.tables.items()} == {
        topic: t.rows() for topic, t in wanted.items()
    }


# -- chains --------------------------------------------------------------------------------------------------


class Peaks(PlainEstimator):
    name = "peaks"
    inputs = (Input("imu", IMU, ("acc_z",), regular=True),)
    outputs = (
        Output("step", POINT, ("pos_x", "pos_y", "pos_z"), annotate=Annotate("step", "instant")),
        Output("height", VALUES, ("z",)),
    )

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self.last: list[tuple[int, float]] = []

    def take(self, message: Message) -> list[Result]:
        self.last = [*self.last[-2:], (message.t_ns, message.values[0])]
        found = [Result("height", message.t_ns, (message.values[0],))]
        if len(self.last) == 3 and self.last[0][1] < self.last[1][1] > self.last[2][1]:
            found.append(Result("step", self.last[1][0], (self.last[1][1], 0.0, 0.0)))
        return found

    def finish(self) -> list[Result]:
        return [Result("step", self.last[-1][0], (-1.0, 0.0, 0.0))] if self.last else []


class Walk(PlainEstimator):
    """Reads steps of another estimator beside the sensor itself."""

    name = "walk"
    inputs = (
        Input("imu", IMU, ("acc_x",), regular=True),
        Input("step", POINT, ("pos_x",)),
    )
    outputs = (Output("trace", VALUES, ("kind", "value", "total")),)

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self.total = 0.0

    def take(self, message: Message) -> list[Result]:
        self.total = self.total * 0.9 + message.values[0]
        kind = 0.0 if message.input == "imu" else 1.0
        return [Result("trace", message.t_ns, (kind, message.values[0], self.total))]


def chained(tables: dict[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    return {t.rpartition("/")[2]: v for t, v in tables.items()}


def chain_oracle(imu: pl.DataFrame) -> list[tuple]:
    """Feed every sample to the first stage, what it says to the second, one after another."""
    peaks, walk, rows, log = Peaks(), Walk(), [], 0
    for t_ns, log, x, _, z in imu.rows():
        message = Message("imu", t_ns, (z,), log, "/p/imu")
        steps = [r for r in peaks.take(message) if r.output == "step"]
        for one in [
            Message("imu", t_ns, (x,), log, "/p/imu"),
            *(Message("step", r.t_ns, (r.values[0],), log, "") for r in steps),
        ]:
            rows += [(r.t_ns, log, *r.values) for r in walk.take(one)]
    for r in peaks.finish():
        rows += [
            (q.t_ns, log, *q.values) for q in walk.take(Message("step", r.t_ns, (r.values[0],), log, ""))
        ]
    return rows


@settings(max_examples=60)
@given(
    z=st.lists(st.sampled_from([0.0, 1.0, 2.0]), min_size=1, max_size=40),
    max_rows=st.integers(1, 45),
    back=st.integers(0, 40),
)
def test_a_chain_equals_one_loop_through_both(z: list[float], max_rows: int, back: int) -> None:
    n = len(z)
    imu = table(
        [10**9 + k * STEP_NS for k in range(n)], {"acc_x": np.arange(n) * 0.5, "acc_y": [0.0] * n, "acc_z": z}
    )
    source, sink = MemorySource([(channel("/p/imu", IMU, ACC), imu)], max_rows), TableSink()

    runs = plan_chain(source)
    engine = Engine(source, runs, sinks=[sink], checkpoint_s=0.03)
    engine.play()
    engine.seek(10**9 + back * STEP_NS)
    engine.play()
    engine.finish()
    trace = sink.table(runs[1].outputs["trace"].topic)
    assert trace is not None
    assert trace.rows() == chain_oracle(imu)


def plan_chain(source: MemorySource) -> Any:
    """Plan Peaks and, behind it, Walk."""

    class Behind(Walk):
        inputs = (Walk.inputs[0], Input("step", POINT, ("pos_x",), stage="tests.peaks"))

    return plan_runs(source, [Behind()], taken=())


def test_estimators_that_serve_one_another_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from marcha.algorithms import registry

    class Loop(Walk):
        name = "tests.loop"
        inputs = (Input("step", POINT, ("pos_x",), stage="tests.loop"),)

    known = registry._load
    point = type("Point", (), {"name": "tests.loop", "value": "x:y", "load": staticmethod(lambda: Loop)})()
    monkeypatch.setattr(registry, "_points", lambda *_: (point,))
    assert known(point) is Loop
    source = MemorySource([(channel("/p/imu", IMU, ACC), table([0], {c: [0.0] for c in ACC}))])
    with pytest.raises(UsageError, match="circle"):
        plan_runs(source, ["tests.loop"])


@pytest.fixture(autouse=True)
def _peaks_are_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    from marcha.algorithms import registry

    point = type(
        "Point", (), {"name": "tests.peaks", "value": "tests:Peaks", "load": staticmethod(lambda: Peaks)}
    )()
    real = registry._points
    monkeypatch.setattr(registry, "_points", lambda *a: (*real(*a), point))


def test_a_stage_is_planned_once_and_its_outputs_are_channels() -> None:
    imu = table([k * STEP_NS for k in range(9)], {c: np.sin(np.arange(9)) for c in ACC})
    source = MemorySource([(channel("/p/imu", IMU, ACC), imu)])

    class Behind(Walk):
        inputs = (Walk.inputs[0], Input("step", POINT, ("pos_x",), stage="tests.peaks"))

    result, tables = run_all(source, ["tests.peaks", Behind(), Behind()])
    assert [r.estimator for r in result.runs] == ["tests.peaks", "walk", "walk"]
    assert result.runs[1].inputs["step"] == ("/estimate/tests_peaks_p_imu/step",)
    assert "/estimate/tests_peaks_p_imu/height" in tables
    assert result.runs[0].annotations["tier"].unique().to_list() == ["tests_peaks_p_imu/step"]


# -- mistakes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("results", "said"),
    [([Result("nonsense", 0, (1.0,))], "nonsense"), ([Result("trace", 0, (1.0,))], "3 columns")],
)
def test_a_result_that_was_not_declared_is_refused(results: list[Result], said: str) -> None:
    class Wrong(Walk):
        inputs = (Walk.inputs[0],)

        def take(self, message: Message) -> list[Result]:
            return results

    source = MemorySource([(channel("/p/imu", IMU, ACC), table([0], {c: [0.0] for c in ACC}))])
    with pytest.raises(MarchaError, match=said):
        run_all(source, [Wrong()])


def test_the_context_holds_what_the_recording_says() -> None:
    seen: list[Context] = []

    class Curious(Walk):
        inputs = (Walk.inputs[0],)

        def start(self, context: Context) -> None:
            seen.append(context)

    source = MemorySource([(channel("/p/imu", IMU, ACC), table([0, STEP_NS], {c: [0.0, 1.0] for c in ACC}))])
    source.metadata = {"device": {"rate": "100"}}
    source.attachments = {"anchors.csv": b"mac,x,y"}
    run_all(source, [Curious()])
    (context,) = seen
    assert context.attachments["anchors.csv"] == b"mac,x,y"
    assert context.metadata["device"]["rate"] == "100"
    assert context.channels["imu"][0].topic == "/p/imu"
    assert context.rate_hz("imu") == 100.0


def test_compiling_is_no_part_of_a_runs_time() -> None:
    """A kernel that was never called: its compilation takes far longer than its loop, and is not in it."""

    compile_once: Any = numba.njit(_nrt=False)  # pyright: ignore[reportCallIssue]

    @compile_once
    def never_called(
        state: Any,
        inputs: Any,
        channels: Any,
        t_ns: Any,
        values: Any,
        out_message: Any,
        out_t_ns: Any,
        out: Any,
    ) -> int:
        for i in range(len(inputs)):
            state[0].angle += values[i, 0]
            out[i, 0], out[i, 1], out[i, 2] = state[0].angle, 0.0, math.nan
            out_message[i], out_t_ns[i] = i, t_ns[i]
        return len(inputs)

    class Fresh(LegKernel):
        name = "fresh"
        run = staticmethod(never_called)

    t_ns = [k * STEP_NS for k in range(1, 51)]
    readings = {c: [0.1] * len(t_ns) for c in ACC}
    source = MemorySource(
        [(channel(f"/leg/{name}", IMU, ACC), table(t_ns, readings)) for name in ("thigh", "shank")], 7
    )
    begin = time.perf_counter()
    result, _ = run_all(source, [Fresh()])
    whole_s = time.perf_counter() - begin
    assert result.runs[0].samples == 100
    assert result.runs[0].loop_s < 0.2 * whole_s
