"""Steps of a phone's carrier from its accelerometer alone, by any of the detectors."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import AlgorithmError, Annotate, Context, Input, KernelEstimator, Output, Remark
from ..numerics.compiled import compiled
from ..parameters import meta
from . import cells, rhythm, ring, surveyed

ACC = Input("acc", "sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z"), regular=True)
STEP = Output(
    "step",
    "marcha_msgs/msg/Step",
    ("swing_s", "index", "length_m", "height_m", "heading_rad"),
    event=True,
    annotate=Annotate("step", "interval", label="step {index}"),
)
FEATURES = ("max", "min", "mean_abs", "mean", "var", "samples", "period_s", "max_low", "min_low")
DETECTOR = Output("detector", "marcha_msgs/msg/NamedValues", FEATURES, event=True)
AT_ONCE = 12
"""Steps that one message makes known at most; what is more follows with the next."""

_YANG = "Yang et al. 2014, phone dissertation, section 3.1.2"


class PhoneStepParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which detector of steps, and its constants."""

    rate_hz: Annotated[
        float,
        meta(
            "Sample rate that turns windows into samples; 0: the measured one, or 50", "Hz", ge=0.0, le=2000.0
        ),
    ] = 0.0
    method: Annotated[
        Literal[
            "best",
            "peaks",
            "gates",
            "tied",
            "zero-crossing",
            "threshold",
            "autocorrelation",
            "spectral",
        ],
        meta("Detector: best is ours, peaks the source's, the others those that it surveys", source=_YANG),
    ] = "best"
    gravity: Annotated[float, meta("Local gravity", "m/s²", gt=0.0, le=30.0)] = 9.80665
    # best
    band_low_hz: Annotated[float, meta("best: lower edge of the band-pass", "Hz", "ours", gt=0.0)] = 1.2
    band_high_hz: Annotated[float, meta("best: upper edge of the band-pass", "Hz", "ours", gt=0.0)] = 3.0
    height_min: Annotated[
        float, meta("best: least height of a peak over the valley before it", "m/s²", "ours", gt=0.0)
    ] = 0.5
    height_share: Annotated[
        float, meta("best: the same as a share of the bout's typical height", "1", "ours", ge=0.0, lt=1.0)
    ] = 0.3
    repeat_min: Annotated[
        float, meta("best: least correlation of two steps with the two before", "1", "ours", lt=1.0)
    ] = 0.5
    run_min: Annotated[
        int, meta("best: peaks in a row that make a bout of walking", "1", "ours", ge=4, le=12)
    ] = 4
    # peaks, gates, tied, zero-crossing, threshold
    window_s: Annotated[
        float,
        meta(
            "peaks, gates, zero-crossing: half window w", "s", f"{_YANG}: 15 samples at 20 Hz", gt=0.0, le=5.0
        ),
    ] = 0.75
    deviation: Annotated[
        Literal["usual", "printed"],
        meta("peaks: σ about the window's mean, or about each sample's own mean", source=f"{_YANG}, eq 3.3"),
    ] = "usual"
    gap_min_s: Annotated[
        float,
        meta("gates, tied, zero-crossing (half), threshold: least interval", "s", "Chon et al. 2012", ge=0.0),
    ] = 0.2
    gap_max_s: Annotated[
        float, meta("gates, zero-crossing: longest interval", "s", "Chon et al. 2012", gt=0.0)
    ] = 1.5
    level: Annotated[
        float,
        meta("threshold: above gravity; tied: beyond the last valley and peak", "m/s²", "ours", gt=0.0),
    ] = 1.0
    low_pass_s: Annotated[
        float, meta("threshold: moving mean before it; 0 none", "s", "ours", ge=0.0, le=2.0)
    ] = 0.1
    # autocorrelation, spectral
    period_window_s: Annotated[
        float, meta("autocorrelation, spectral: window", "s", "Rai et al. 2012", gt=1.0, le=10.0)
    ] = 4.0
    swing_min: Annotated[
        float,
        meta("autocorrelation, spectral: least deviation of ‖f‖", "m/s²", "Rai et al. 2012: 0.01 g", gt=0.0),
    ] = 0.4
    share_min: Annotated[
        float,
        meta(
            "autocorrelation: least correlation; spectral: half of it is the least share",
            "1",
            "Rai et al. 2012",
        ),
    ] = 0.7


FIELDS: list[tuple[Any, ...]] = [
    *ring.FIELDS,
    *cells.FIELDS,
    *surveyed.FIELDS,
    ("local", "i8"),  # 1: a detector on the device's own samples
    ("features", "f8", (ring.N_FEATURES,)),
    ("steps", "i8"),
    ("restless", "f8"),
]
_CELLS = {"best": cells.RHYTHM, "autocorrelation": cells.AUTOCORRELATION, "spectral": cells.SPECTRAL}


def configure(s: Any, p: PhoneStepParams, rate_hz: float) -> None:
    """Write the detector and its constants into record ``s``."""
    half = round(p.window_s * rate_hz)
    if half > surveyed.MAX_HALF:
        raise AlgorithmError(
            f"window_s = {p.window_s} is {half} samples at {rate_hz:g} Hz; at most {surveyed.MAX_HALF}"
        )
    if p.band_low_hz >= p.band_high_hz:
        raise AlgorithmError(f"band_low_hz = {p.band_low_hz} must be below band_high_hz = {p.band_high_hz}")
    s["method"] = _CELLS.get(p.method, cells.RHYTHM)
    s["local"] = 0 if p.method in _CELLS else 1
    s["taps"][:] = rhythm.band_pass(p.band_low_hz, p.band_high_hz)
    s["height_min"], s["height_share"] = p.height_min, p.height_share
    s["repeat_min"], s["run_min"] = p.repeat_min, p.run_min
    s["rest_gap_s"], s["longest_gap_s"] = 0.27, 1.2
    s["unlike_max"] = 3.0
    s["window_cells"] = round(p.period_window_s * 1e9 / ring.CELL_NS)
    s["swing_min"] = p.swing_min
    s["share_min"] = p.share_min * (0.5 if p.method == "spectral" else 1.0)
    s["shortest_s"], s["longest_s"] = 0.3, 1.0
    s["kind"] = surveyed.METHODS.index(p.method) if p.method in surveyed.METHODS else 0
    s["half"] = max(1, half) if p.method != "tied" else 1
    s["printed"] = p.deviation == "printed"
    s["least_s"] = p.gap_min_s * (0.5 if p.method == "zero-crossing" else 1.0)
    s["most_s"] = p.gap_max_s
    s["level"], s["gravity"] = p.level, p.gravity
    s["smooth"] = max(1, round(p.low_pass_s * rate_hz))


@compiled
def take(s: Any, t_ns: int, x: float, y: float, z: float) -> int:
    """Take a specific force; return its place in the ring. Steps go into the queue."""
    norm = math.sqrt(x * x + y * y + z * z)
    i = ring.push(s, t_ns, norm)
    if s.local == 1:
        surveyed.take(s)
    else:
        cells.take(s, t_ns, norm)
    return i


@compiled
def shift_queue(s: Any, n: int) -> None:
    """Take the first ``n`` steps off the queue."""
    for k in range(n, s.queued):
        s.queue_start[k - n] = s.queue_start[k]
        s.queue_end[k - n] = s.queue_end[k]
        s.queue_quality[k - n] = s.queue_quality[k]
    s.queued -= n


@compiled
def _give(s: Any, limit: int, cause: int, out_message: Any, out_t_ns: Any, out: Any, count: int) -> int:
    n = min(s.queued, limit)
    for k in range(n):
        start, end = s.queue_start[k], s.queue_end[k]
        ring.features(s, start, end, s.gravity, s.features)
        out_message[count], out_t_ns[count] = cause, end
        out[count, 0], out[count, 1] = (end - start) * 1e-9, s.steps
        for j in range(2, 5):
            out[count, j] = np.nan
        for j in range(ring.N_FEATURES):
            out[count, 5 + j] = s.features[j]
        s.steps += 1
        count += 1
    shift_queue(s, n)
    return count


@compiled
def run(
    state: Any, inputs: Any, channels: Any, t_ns: Any, values: Any, out_message: Any, out_t_ns: Any, out: Any
) -> int:
    """Take messages; see :class:`..contract.KernelEstimator`."""
    s, count = state[0], 0
    for i in range(t_ns.shape[0]):
        take(s, t_ns[i], values[i, 0], values[i, 1], values[i, 2])
        count = _give(s, AT_ONCE, i, out_message, out_t_ns, out, count)
    return count


@compiled
def run_end(state: Any, out_t_ns: Any, out: Any) -> int:
    """Give the steps still held back."""
    s = state[0]
    if s.local == 0:
        cells.settle(s)
    return _give(s, ring.QUEUE, 0, out_t_ns, out_t_ns, out, 0)


class PhoneSteps(KernelEstimator):
    """Steps of a person who carries a phone, from the norm of its specific force.

    ``best`` holds with one set of constants in hand, pocket, bag, armband, neck pouch and swinging arm, and is
    silent when nobody walks; see :mod:`.rhythm`. The first steps of a bout are known when it is known to be
    one, about 3 s late; later ones after 0.9 s. ``peaks`` is the source's detector (eqs 3.1–3.9) with the
    statistics of the intervals so far; :func:`.source.source_steps` is its batch form. A step is
    given at its end, from peak to peak of the force.
    """

    name: ClassVar[str] = "phone.steps"
    title: ClassVar[str] = "steps of a phone's carrier from the accelerometer"
    source: ClassVar[str] = "phone dissertation, section 3.1.2; best: ours"
    Params = PhoneStepParams
    inputs = (ACC,)
    outputs = (STEP, DETECTOR)
    run = staticmethod(run)
    run_end = staticmethod(run_end)
    max_results: int = AT_ONCE
    max_held: int = ring.QUEUE
    dtype: ClassVar[np.dtype[Any]] = np.dtype(FIELDS)

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.state = np.zeros(1, self.dtype)

    def start(self, context: Context) -> None:
        """Set windows by the measured rate."""
        super().start(context)
        self.state[:] = np.zeros(1, self.dtype)
        configure(self.state[0], self.params, self.params.rate_hz or context.rate_hz("acc") or 50.0)

    def remarks(self) -> list[Remark]:
        """Say where no step was found, or more than could be kept."""
        return step_remarks(self.state[0])


def step_remarks(s: Any) -> list[Remark]:
    """Return what a user must know about the steps of record ``s``."""
    remarks: list[Remark] = []
    if s["taken"] == 0:
        remarks.append(Remark("no_samples", "no sample of the accelerometer arrived", fatal=True))
    elif s["steps"] == 0:
        remarks.append(
            Remark("no_steps", "no step was found: nobody walked, or the method does not suit the placement")
        )
    if s["dropped"]:
        remarks.append(
            Remark("dropped_steps", f"{int(s['dropped'])} steps at once were too many and are lost")
        )
    return remarks
