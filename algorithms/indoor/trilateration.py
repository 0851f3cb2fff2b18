"""``indoor.trilateration``: a position a window, from the signal strengths of known anchors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

import msgspec
import numpy as np

from ..contract import AlgorithmError, Context, Input, Message, Output, PlainEstimator, Remark, Result
from .anchors import anchors_of
from .windows import RangingParams, WindowRanges, Windows

RADIO = Input("radio", "marcha_msgs/msg/RadioSignal", ("mac", "rssi_dbm"), many=True)
RANGES = Input("ranges", "marcha_msgs/msg/Ranging", ("mac", "distance_m"), optional=True, many=True)
POSITION = Output("position", "geometry_msgs/msg/PointStamped", ("pos_x", "pos_y", "pos_z"), frame="plan")
SIGMA = Output(
    "sigma", "marcha_msgs/msg/NavigationSigma", ("sigma_pos_x", "sigma_pos_y", "sigma_pos_z"), frame="plan"
)
_RANGE = ("mac", "distance_m", "technology", "sd_m")
TRIPLES = Output("triples", "marcha_msgs/msg/NamedValues", ("triple_x", "triple_y"), event=True, frame="plan")
RANGED = (
    Output("ranges", "marcha_msgs/msg/Ranging", _RANGE, frame="plan"),
    Output("corrected", "marcha_msgs/msg/Ranging", _RANGE, frame="plan"),
    TRIPLES,
)


class IndoorTrilateration(PlainEstimator):
    """Windows of powers, ranges by the log-distance model, correction by vote, fix.

    A window is closed by the first message at or after its end, and its fix speaks of its end.
    """

    name: ClassVar[str] = "indoor.trilateration"
    title: ClassVar[str] = "position a window from signal strengths of known anchors"
    source: ClassVar[str] = "hybrid indoor positioning, sections 4.4.1–4.4.4, eqs 3.6–3.21, 4.3–4.6"
    Params: ClassVar[type[msgspec.Struct]] = RangingParams
    presets: ClassVar = {"wls": {"method": "wls", "correction": "none", "reach_m": 0.0}}
    inputs = (RADIO, RANGES)
    outputs = (POSITION, SIGMA, *RANGED)

    def start(self, context: Context) -> None:
        """Find the anchors."""
        self.windows = Windows(self.params, anchors_of(context, without=self.params.without))
        if not len(self.windows.anchors):
            raise AlgorithmError(f"{self.name}: no anchor is left")

    def take(self, message: Message) -> Iterable[Result]:
        """Take one power or range."""
        closed = self.windows.close(message.t_ns)
        mac, value = str(message.values[0]), float(message.values[1])
        results = self.answer(closed) if closed is not None else []
        if message.input == "radio":
            self.windows.power(mac, value)
        else:
            self.windows.distance(mac, value)
        return results

    def answer(self, ranges: WindowRanges) -> list[Result]:
        """Return the results of a window."""
        fix = self.windows.fix(ranges)
        results = list(ranging_results(self.windows, ranges))
        if fix is not None:
            (x, y), covariance = fix
            results.append(Result("position", ranges.end_ns, (x, y, self.params.height_m)))
            sd = np.sqrt(np.diag(covariance))
            results.append(Result("sigma", ranges.end_ns, (sd[0], sd[1], np.nan)))
        return results

    def remarks(self) -> list[Remark]:
        """Say how many windows had no fix, and why."""
        return self.windows.remarks()


def ranging_results(windows: Windows, ranges: WindowRanges) -> Iterable[Result]:
    """Yield the ranges of a window before and after the correction, and what each three anchors say."""
    a = windows.anchors
    for i, k in enumerate(ranges.anchors.tolist()):
        about = (a.technology[k], float(ranges.sigma[i]))
        yield Result("ranges", ranges.end_ns, (a.macs[k], float(ranges.plane[i]), *about))
        yield Result("corrected", ranges.end_ns, (a.macs[k], float(ranges.better[i]), *about))
    for x, y in ranges.triples.tolist():
        yield Result("triples", ranges.end_ns, (x, y))
