"""``indoor.hybrid``: the source's fusion of trilateration and dead reckoning, a Kalman filter a window."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, ClassVar, get_type_hints

import msgspec
import numpy as np

from ..contract import Context, Message, PlainEstimator, Remark, Result
from ..parameters import meta
from .anchors import anchors_of
from .pdr import IMU, MAG, ORIENTATION, STEP, IndoorStepParams, SourceSteps
from .trilateration import POSITION, RADIO, RANGED, SIGMA, ranging_results
from .windows import SOURCE, RangingParams, Windows


class FusionParams(RangingParams, frozen=True, kw_only=True):
    """Parameters of ranging and fusion."""

    q: Annotated[
        float,
        meta("variance that a window's dead reckoning adds, each axis", "m²", f"{SOURCE}, table 5.5", gt=0),
    ] = 0.38
    r: Annotated[
        float, meta("variance of a trilaterated position, each axis", "m²", f"{SOURCE}, table 5.5", gt=0)
    ] = 1.0
    p0: Annotated[float, meta("variance of a known start", "m²", "not given in the source", ge=0)] = 1.0
    move_fix: Annotated[
        bool,
        meta(
            "move a fix by half of the window's steps: powers of a window speak of its middle (not in the "
            "source)",
            "",
        ),
    ] = False
    known_start: Annotated[
        bool, meta("start at start_x, start_y of the plan; else the first fix starts the track", "")
    ] = False


HybridParams = msgspec.defstruct(
    "HybridParams",
    [
        (name, kind, getattr(IndoorStepParams(), name))
        for name, kind in get_type_hints(IndoorStepParams, include_extras=True).items()
        if name not in FusionParams.__struct_fields__
    ],
    bases=(FusionParams,),
    frozen=True,
    kw_only=True,
)
"""Parameters of ranging, steps and fusion."""


def steady_gain(r: float, q: float) -> float:
    """Return the gain to which the filter settles: p = P + q with P = p r / (p + r), K = p / (p + r)."""
    predicted = (q + math.sqrt(q * q + 4.0 * q * r)) / 2.0
    return predicted / (predicted + r)


class IndoorHybrid(PlainEstimator):
    """x̂ = x + u, P = P + Q a window; K = P / (P + R), x = x̂ + K (y − x̂), P = (1 − K) P with each fix y.

    u is the sum of the window's steps. Windows without a fix only predict. Between the windows the predicted
    position follows the steps. Both axes have the same P.
    """

    name: ClassVar[str] = "indoor.hybrid"
    title: ClassVar[str] = "the source's fusion: trilateration by windows and dead reckoning, Kalman filter"
    source: ClassVar[str] = "hybrid indoor positioning, eqs 3.28–3.32 and 4.7–4.8"
    Params: ClassVar[type[msgspec.Struct]] = HybridParams
    inputs = (RADIO, IMU, ORIENTATION, MAG)
    outputs = (POSITION, SIGMA, STEP, *RANGED)

    def start(self, context: Context) -> None:
        """Find the anchors and the plan's frame."""
        p = self.params
        self.windows = Windows(p, anchors_of(context, without=p.without))
        self.steps = SourceSteps(p, context)
        self.at = np.array([p.start_x, p.start_y]) if p.known_start else np.full(2, np.nan)
        self.last = self.at.copy()  # at the end of the last window
        self.variance = p.p0
        self.fixes = 0

    def take(self, message: Message) -> Iterable[Result]:
        """Take one message; a window that it is beyond is closed first."""
        results: list[Result] = []
        closed = self.windows.close(message.t_ns)
        if closed is not None:
            self.variance += self.params.q
            fix = self.windows.fix(closed)
            results += ranging_results(self.windows, closed)
            if fix is not None:
                self.update(fix[0])
            self.last = self.at.copy()
            results += self.answer(closed.end_ns)
        if message.input == "radio":
            self.windows.power(str(message.values[0]), float(message.values[1]))
        elif (step := self.steps.take(message)) is not None:
            start, end, index, length, heading = step
            results.append(Result("step", end, (start, end, index, length, 0.0, heading)))
            self.at = self.at + length * np.array([math.cos(heading), math.sin(heading)])
            results += self.answer(end)
        return results

    def update(self, fix: np.ndarray) -> None:
        """Take a trilaterated position (eqs 3.30–3.32).

        Shape of ``fix``: (2,), m.
        """
        self.fixes += 1
        if np.isnan(self.at).any():
            self.at, self.variance = fix.copy(), self.params.r
            return
        if self.params.move_fix:
            fix = fix + 0.5 * (self.at - self.last)
        gain = self.variance / (self.variance + self.params.r)
        self.at = self.at + gain * (fix - self.at)
        self.variance *= 1.0 - gain

    def answer(self, t_ns: int) -> list[Result]:
        """Return the position at a time, nothing while it is not known."""
        if np.isnan(self.at).any():
            return []
        sd = math.sqrt(self.variance)
        return [
            Result("position", t_ns, (self.at[0], self.at[1], self.params.height_m)),
            Result("sigma", t_ns, (sd, sd, np.nan)),
        ]

    def remarks(self) -> list[Remark]:
        """Say what a user must know of the run."""
        remarks = self.windows.remarks()
        if self.fixes == 0 and self.params.known_start:  # dead reckoning alone, which is still a track
            remarks = [Remark(r.kind, f"{r.detail}; dead reckoning only", False) for r in remarks]
        return remarks + self.steps.remarks()
