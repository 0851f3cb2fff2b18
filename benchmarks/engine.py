"""What the engine itself takes: three inputs merged for a kernel beside vqf, a plain class beside a bare loop."""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar

import marcha.recording as mr
import numpy as np
from marcha.algorithms import Context, Input, KernelEstimator, Message, Output, PlainEstimator, Result
from marcha.algorithms.numerics.compiled import compiled
from marcha.replay import replay

from . import Row

IMU, JOINT, VALUES = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState", "marcha_msgs/msg/NamedValues"
GYR = ("gyr_x", "gyr_y", "gyr_z")
SECONDS, PLAIN_SECONDS = 4_000, 400
RATES = (("/leg/thigh/imu", 100.0), ("/leg/shank/imu", 148.0), ("/leg/encoder", 30.0))
OF_VQF, OF_BARE_LOOP = 0.3, 2.5
PAIRS = 5
"""Ours and the peer's are measured in turn; the pair with the median ratio counts."""


class LegKernel(KernelEstimator):
    """Knee angle from two gyroscopes, pulled to an encoder, compiled."""

    name: ClassVar[str] = "bench.leg-kernel"
    inputs = (
        Input("thigh", IMU, GYR, regular=True),
        Input("shank", IMU, GYR, regular=True),
        Input("encoder", JOINT, ("knee",)),
    )
    outputs = (Output("angle", VALUES, ("angle_rad",)),)

    def start(self, context: Context) -> None:
        super().start(context)
        self.state = np.zeros(1, np.dtype([("angle", "f8"), ("last_ns", "i8", (2,))]))


@compiled
def _run(
    state: Any, inputs: Any, channels: Any, t_ns: Any, values: Any, out_message: Any, out_t_ns: Any, out: Any
) -> int:
    s = state[0]
    for i in range(len(inputs)):
        if inputs[i] == 2:
            s.angle += 0.2 * (values[i, 0] - s.angle)
        else:
            k = inputs[i]
            dt = 1e-9 * (t_ns[i] - s.last_ns[k]) if s.last_ns[k] > 0 else 0.0
            s.last_ns[k] = t_ns[i]
            s.angle += (2 * k - 1) * values[i, 1] * dt
        out[i, 0] = s.angle
        out_message[i], out_t_ns[i] = i, t_ns[i]
    return len(inputs)


LegKernel.run = staticmethod(_run)


class LegPlain(PlainEstimator):
    """The same as a plain class."""

    name: ClassVar[str] = "bench.leg"
    inputs = LegKernel.inputs
    outputs = LegKernel.outputs

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self.angle, self.last_ns = 0.0, [0, 0]

    def take(self, message: Message) -> Iterable[Result]:
        if message.input == "encoder":
            self.angle += 0.2 * (message.values[0] - self.angle)
        else:
            k = int(message.input == "shank")
            dt = 1e-9 * (message.t_ns - self.last_ns[k]) if self.last_ns[k] else 0.0
            self.last_ns[k] = message.t_ns
            self.angle += (2 * k - 1) * message.values[1] * dt
        return [Result("angle", message.t_ns, (self.angle,))]


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` 1 merges 1,112,000 messages for the kernel and a tenth for the plain class."""
    with tempfile.TemporaryDirectory() as folder:
        long, short = Path(folder, "long.mcap"), Path(folder, "short.mcap")
        n, gyr = _recording(long, max(40.0, SECONDS * scale))
        few, _ = _recording(short, max(40.0, PLAIN_SECONDS * scale))
        kernel = lambda: replay(mr.open(long), [LegKernel], metrics=False)  # noqa: E731
        kernel()
        blocks, vqf = _median(
            [(n / _best(kernel), len(gyr) / _best(lambda: _vqf(gyr))) for _ in range(PAIRS)]
        )
        messages = _messages(mr.open(short))
        ready, per = [Message(*fields) for fields in messages], 1e6 / few
        plain = lambda: replay(mr.open(short), [LegPlain], metrics=False)  # noqa: E731
        kept = _median([(_best(plain), _best(lambda: _bare(messages))) for _ in range(PAIRS)])
        thrown = _median([(_best(plain), _best(lambda: _bare_away(ready))) for _ in range(PAIRS)])
    return [
        Row("replay of two IMUs and an encoder in blocks, results in memory", blocks, "messages/s",
            "vqf (C++), orientation only, no files", vqf, blocks / vqf, f"≥ {OF_VQF} × vqf", blocks >= OF_VQF * vqf),
        Row("replay of a plain class, whole, a message", kept[0] * per, "µs",
            "bare loop that makes the messages and keeps the results", kept[1] * per, kept[0] / kept[1],
            f"≤ {OF_BARE_LOOP}", kept[0] <= OF_BARE_LOOP * kept[1]),
        Row("the same", thrown[0] * per, "µs", "bare loop over ready messages that drops the results",
            thrown[1] * per, thrown[0] / thrown[1], "", True),
    ]  # fmt: skip


def _median(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    return sorted(pairs, key=lambda p: p[0] / p[1])[len(pairs) // 2]


def _best(task: Callable[[], Any], times: int = 2) -> float:
    best = np.inf
    for _ in range(times):
        gc.collect()
        begin = time.perf_counter()
        task()
        best = min(best, time.perf_counter() - begin)
    return best


def _recording(path: Path, seconds: float) -> tuple[int, np.ndarray]:
    """Write three channels at three rates; return how many messages, and readings for vqf."""
    rng = np.random.default_rng(0)
    total = 0
    readings = np.empty((0, 6))
    with mr.create(path) as out:
        for topic, rate_hz in RATES:
            t_ns = 10**9 + (np.arange(int(seconds * rate_hz)) / rate_hz * 1e9).astype(np.int64)
            total += len(t_ns)
            if topic == "/leg/encoder":
                out.add_table(topic, JOINT, {"t_ns": t_ns, "knee": 0.5 * np.sin(t_ns / 1e9)})
                continue
            columns = (*(f"acc_{a}" for a in "xyz"), *GYR)
            values = {name: rng.normal(size=len(t_ns)) for name in columns}
            out.add_table(topic, IMU, {"t_ns": t_ns, **values})
            readings = np.column_stack([values[c] for c in columns])
    return total, readings


def _messages(rec: mr.Recording) -> list[tuple[str, int, tuple[float, ...], int, str]]:
    """Return the fields of all messages in the order of log time, as a loop of one's own would have them."""
    roles = {
        "/leg/thigh/imu": ("thigh", GYR),
        "/leg/shank/imu": ("shank", GYR),
        "/leg/encoder": ("encoder", ("knee",)),
    }
    return [
        (roles[m.topic][0], m.t_ns, tuple(m.values[c] for c in roles[m.topic][1]), m.t_log_ns, m.topic)
        for m in rec.messages()
    ]


def _bare(messages: list[tuple[str, int, tuple[float, ...], int, str]]) -> list[Result]:
    take = LegPlain().take
    kept: list[Result] = []
    for fields in messages:
        kept.extend(take(Message(*fields)))
    return kept


def _bare_away(messages: list[Message]) -> None:
    take = LegPlain().take
    for message in messages:
        take(message)


def _vqf(readings: np.ndarray) -> None:
    from vqf import VQF

    acc, gyr = np.ascontiguousarray(readings[:, :3]), np.ascontiguousarray(readings[:, 3:])
    VQF(0.01).updateBatch(gyr, acc)
