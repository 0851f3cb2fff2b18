"""A sample's way through the state that all foot estimators share.

A row is taken (:func:`take`) into the ring, watched for the rest at the start, and judged by the detector;
once the decision about sample k − latency is there, :func:`release` hands that sample to the filter, which
ends with :func:`emit`. A filter's kernel is therefore four lines; see :mod:`.iez9`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..numerics.compiled import compiled, inlined
from ..numerics.records import Fields, record_type
from ..numerics.rotations import quat_of
from ..numerics.strapdown import NAVIGATION
from . import ceiling, rest
from .detectors import DETECTOR, PITCH, decide
from .detectors.pitch import start_tilt, track_tilt

FloatArray = NDArray[np.float64]

STEPS = record_type(
    ("min_s", "f8"),
    ("min_m", "f8"),
    ("count", "i8"),
    ("landing", "f8", (3,)),  # position of the newest landing, m
    ("swing", "f8"),  # s since the newest still sample
    ("was_still", "?"),
)

LONGEST_SWING_S = 5.0
"""s: who moves for longer without a stance has lost them."""
LONGEST_STRIDE_M = 4.0
TURN_S, GAIT_S = 0.1, 1.0
"""s: averages of ‖ω‖ that show a swing, and what is usual in this gait."""
LEAST_TURNING = 0.5
"""rad/s: below this a foot does not walk."""
QUIET = 0.15
"""rad/s: a foot that stands by itself turns by less."""
CARRIED_S, STOOD_S = 0.3, 5.0
"""s: averages of ‖f‖ that tell a floor's acceleration from what a standing sensor reads."""
CARRIED = 0.035
"""m/s²: no foot of the developers' 34 recordings, reached 0.03."""
CARRIED_FOR_S = 0.5
STANDS_AFTER_S = 1.5
"""s: the landing has died away."""
SURPRISE = 16.27
"""99.9 % of a chi-square with three degrees of freedom."""

VERDICT = record_type(
    ("fastest", "f8"),  # m/s
    ("longest_stride", "f8"),  # m
    ("n_long_strides", "i8"),
    ("n_landings", "i8"),
    ("navigated_s", "f8"),
    ("lost_s", "f8"),  # time in swings beyond LONGEST_SWING_S
    ("path_m", "f8"),  # way of the track
    ("steps_m", "f8"),  # sum of the steps
    ("turning", "f8"),  # rad/s, ‖ω‖ averaged over TURN_S
    ("usual_turning", "f8"),  # the same over GAIT_S
    ("swings", "i8"),  # times that the foot turned, by the gyroscope alone
    ("is_turning", "?"),
    ("n_judged", "i8"),  # stances whose velocity was compared with what P expects
    ("n_surprising", "i8"),  # those outside the 99.9 % ellipsoid
    ("first_bias", "f8", (3,)),  # rad/s, of the gyroscope at the start
    ("unsure_m", "f8"),  # the horizontal position's own standard deviation, at the newest sample
    ("quiet_s", "f8"),  # since the foot has stood without turning
    ("force_now", "f8"),  # m/s², ‖f‖ averaged over CARRIED_S
    ("force_usual", "f8"),  # the same over STOOD_S
    ("carried_s", "f8"),  # since these differ by more than CARRIED
    ("carried_at", "f8"),  # s since the first row, when it was so for the first time; 0 never
    ("carried_by", "f8"),  # m/s², greatest difference
    ("at_lowest", "i8", (6,)),  # samples at the lowest value of each column
    ("at_highest", "i8", (6,)),
)
"""What says whether the results can be a walk."""

STANCE_VELOCITY = record_type(
    ("change", "f8", (3,)),  # m/s, of the velocity by the accelerometer since the stance began, n
    ("first", "f8", (3,)),  # what the rolling foot's velocity was then
    ("count", "i8"),
    ("total", "f8", (3,)),  # sum of the change beyond what rolling explains
    ("squares", "f8", (3,)),
    ("n", "i8"),  # stances of steps
    ("variance", "f8", (3,)),  # m²/s², of that in a stance, mean over them
    ("along", "f8", (2,)),  # direction of the newest step
    ("way", "f8", (2,)),  # s, of walking in the directions of the steps, summed as vectors
    ("time", "f8"),  # s, of walking
)
"""How far the velocity of the standing foot is from what its rolling explains, by its own accelerometer."""

CORE: Fields = [
    *NAVIGATION,
    ("started", "?"),
    ("n_still", "i8"),  # still samples since the start
    ("stance_s", "f8"),  # s that the foot has been still without a break, at the released sample
    ("taken", "i8"),  # rows taken
    ("decided", "i8"),  # row up to which the detector's stages have come; runs past the end in a flush
    ("released", "i8"),  # samples handed to the filter
    ("time", "f8"),  # s since the first row, at the newest row
    ("time_out", "f8"),  # the same at the released sample
    ("repaired", "i8"),  # rows with a value that was not finite (held)
    ("lowest", "f8", (6,)),  # of acceleration and angular rate
    ("highest", "f8", (6,)),
    ("unknown_bias", "f8"),  # variance of a gyroscope bias that is no error state, rad²/s²
    ("unknown_tilt", "f8"),  # variance of the tilt that an accelerometer's bias hides, rad²
    ("forward", "f8", (3,)),  # sum of the steps, each turned into b where it lands: the foot's direction
    ("lean", "f8", (2,)),  # of the horizontal position on the gyroscope's bias about the vertical, m s/rad
    ("creep", STANCE_VELOCITY),
    ("steps", STEPS),
    ("verdict", VERDICT),
    ("rest", rest.REST),
    ("ceiling", ceiling.CEILING),
    ("detector", DETECTOR),
]
"""Fields of every foot estimator's state, behind the filter's own.

That order counts: numba takes a record for a subtype of one whose fields it begins with, and says so in a
warning with every call.
"""

# Where the results lie in a result vector
POSE, VELOCITY, STILL, STEP, SIGMA = 0, 7, 10, 11, 16
AFTER_SIGMA = 25


@inlined
def take(s: Any, ring: Any, row: FloatArray) -> bool:
    """Take a row into the state; return whether a sample can be released to the filter.

    A value that is not finite is replaced by the previous row's (and counted): one NaN must not ruin the run.
    """
    mask = ring.shape[0] - 1
    k = s.taken
    r = ring[k & mask]
    previous = ring[(k - 1) & mask] if k > 0 else r
    dt = row[0] if k > 0 else 0.0
    s.taken = k + 1
    s.time += dt
    r.dt = dt
    repaired = False
    for i in range(3):
        value = row[1 + i]
        if not math.isfinite(value):
            repaired = True
            value = previous.acc[i] if k > 0 else 0.0
        r.acc[i] = value
        _widen(s, i, value, k)
        value = row[4 + i]
        if not math.isfinite(value):
            repaired = True
            value = previous.gyr[i] if k > 0 else 0.0
        r.gyr[i] = value
        _widen(s, 3 + i, value, k)
    if repaired:
        s.repaired += 1
    for i in range(4):
        r.extra[i] = row[7 + i] if 7 + i < row.shape[0] else math.nan
    x, y, z = r.acc[0], r.acc[1], r.acc[2]
    r.acc_norm = math.sqrt(x * x + y * y + z * z)
    x, y, z = r.gyr[0], r.gyr[1], r.gyr[2]
    r.gyr_norm = math.sqrt(x * x + y * y + z * z)
    for i in range(3):
        r.doubt[i] = 0.0
    if rest.watch(s.rest, r, k, s.time):
        start_tilt(s.detector.pitch, s.rest.acc)
    if s.rest.index < 0:
        r.pitch = math.nan
    elif s.detector.kind == PITCH:
        track_tilt(s.detector.pitch, s.rest.gyr, r)
    s.decided = k
    decide(s.detector, ring, k, k)
    if s.ceiling.on:
        ceiling.watch(s.ceiling, ring, k, s.released)
    return k >= s.detector.latency


@inlined
def _widen(s: Any, column: int, value: float, k: int) -> None:
    if k == 0 or value < s.lowest[column]:
        s.lowest[column] = value
        s.verdict.at_lowest[column] = 0
    if k == 0 or value > s.highest[column]:
        s.highest[column] = value
        s.verdict.at_highest[column] = 0
    if value == s.lowest[column]:
        s.verdict.at_lowest[column] += 1
    if value == s.highest[column]:
        s.verdict.at_highest[column] += 1


@compiled
def take_end(s: Any, ring: Any) -> bool:
    """After the last row: decide about the next sample held back, windows cut off; False if none is left."""
    last = s.taken - 1
    j = s.released
    if j > last:
        return False
    # Where fewer rows came than the latency, stages are behind by more than one row.
    while s.decided < j + s.detector.latency:
        s.decided += 1
        decide(s.detector, ring, s.decided, last)
    return True


@inlined
def release(s: Any, ring: Any) -> Any:
    """Count the next sample as released and return it."""
    r = ring[s.released & (ring.shape[0] - 1)]
    s.released += 1
    s.time_out += r.dt
    s.stance_s = s.stance_s + r.dt if r.still else 0.0
    return r


@inlined
def starts(s: Any, r: Any) -> bool:
    """Start the navigation where the released sample ``r`` completed the rest; return True at that sample only."""
    if s.started:
        return False
    if s.rest.adaptive and s.rest.index < 0:
        rest.watch_stance(s.rest, r, s.released - 1, s.time_out)
    if s.rest.index < 0 or s.released - 1 != s.rest.index:
        return False
    rest.start(s)
    for i in range(3):
        s.verdict.first_bias[i] = s.bias_gyr[i]
    s.started = True
    s.steps.was_still = True
    return True


@inlined
def emit(s: Any, r: Any, out: FloatArray) -> None:
    """Write pose, velocity, stance and step of the sample ``r``; NaN before the navigation has started."""
    out[STILL] = 1.0 if r.still else 0.0
    for i in range(5):
        out[STEP + i] = math.nan
    if not s.started:
        for i in range(POSE, STILL):
            out[i] = math.nan
        return
    for i in range(3):
        out[POSE + i] = s.pos[i]
        out[VELOCITY + i] = s.vel[i]
    out[POSE + 3], out[POSE + 4], out[POSE + 5], out[POSE + 6] = quat_of(s.rot)
    s.steps.swing += r.dt
    _note_verdict(s, r)
    if r.still:
        s.n_still += 1
        if not s.steps.was_still:
            _land(s, out)
        s.steps.swing = 0.0
    s.steps.was_still = r.still


@inlined
def _note_verdict(s: Any, r: Any) -> None:
    """Note what the sample ``r`` says of the plausibility of the run."""
    v = s.verdict
    v.navigated_s += r.dt
    if s.stance_s <= LONGEST_STANCE_S and s.steps.count > 0:
        s.creep.time += r.dt
        for i in range(2):
            s.creep.way[i] += s.creep.along[i] * r.dt
    s.lean[0] -= v.navigated_s * s.vel[1] * r.dt
    s.lean[1] += v.navigated_s * s.vel[0] * r.dt
    speed = s.vel[0] * s.vel[0] + s.vel[1] * s.vel[1] + s.vel[2] * s.vel[2]
    if speed > v.fastest * v.fastest:
        v.fastest = math.sqrt(speed)
    v.path_m += math.sqrt(speed) * r.dt
    if s.steps.swing > LONGEST_SWING_S:
        v.lost_s += r.dt
    _count_swings(v, r)
    _watch_floor(s, r)


@inlined
def _watch_floor(s: Any, r: Any) -> None:
    """Note where the floor accelerates under a standing foot, as a lift does.

    A constant ride is not to be told from rest; its beginning and end are. A foot that does not turn reads a
    constant ‖f‖, whatever bias and scale are, unless the floor under it accelerates up or down.
    """
    v = s.verdict
    x, y, z = r.gyr[0] - s.bias_gyr[0], r.gyr[1] - s.bias_gyr[1], r.gyr[2] - s.bias_gyr[2]
    if not r.still or x * x + y * y + z * z > QUIET * QUIET:
        v.quiet_s = 0.0
        return
    if v.quiet_s == 0.0:
        v.force_now = v.force_usual = r.acc_norm
        v.carried_s = 0.0
    v.quiet_s += r.dt
    if v.quiet_s > 0.0:
        v.force_now += (r.acc_norm - v.force_now) * min(1.0, r.dt / min(CARRIED_S, v.quiet_s))
        v.force_usual += (r.acc_norm - v.force_usual) * min(1.0, r.dt / min(STOOD_S, v.quiet_s))
    off = abs(v.force_now - v.force_usual)
    v.carried_s = v.carried_s + r.dt if off > CARRIED and v.quiet_s > STANDS_AFTER_S else 0.0
    if v.carried_s > CARRIED_FOR_S:
        v.carried_by = max(v.carried_by, off)
        if v.carried_at == 0.0:
            v.carried_at = s.time_out


@inlined
def _count_swings(v: Any, r: Any) -> None:
    """Count swings by the gyroscope alone: ‖ω‖ rises above what is usual in this gait, and falls below it again.

    It knows of no stance detector, so it can tell when one is wrong.
    """
    v.turning += (r.gyr_norm - v.turning) * min(1.0, r.dt / TURN_S)
    v.usual_turning += (r.gyr_norm - v.usual_turning) * min(1.0, r.dt / GAIT_S)
    if v.is_turning:
        v.is_turning = v.turning > 0.7 * v.usual_turning
    elif v.turning > max(1.2 * v.usual_turning, LEAST_TURNING):
        v.is_turning = True
        v.swings += 1


LONGEST_STANCE_S = 0.5
"""s: a foot that is still for longer stands; it does not roll on."""
FEWEST_IN_STANCE = 4


@compiled
def _note_creep(s: Any, r: Any) -> None:
    """Note how the sensor's velocity changes in a stance, beyond what the rolling foot explains.

    ``s.stance_vel`` is what it explains. What changes by so much within a stance is not known better on the whole
    of it: shoe and foot give, and the same way in every stance. No later stance shows that error.
    """
    c = s.creep
    if s.stance_s <= r.dt:
        if c.count >= FEWEST_IN_STANCE and s.steps.count > 0:
            c.n += 1
            for i in range(3):
                average = c.total[i] / c.count
                c.variance[i] += (c.squares[i] / c.count - average * average - c.variance[i]) / c.n
        c.count = 0
        for i in range(3):
            c.total[i] = 0.0
            c.squares[i] = 0.0
            c.change[i] = 0.0
            c.first[i] = s.stance_vel[i]
    elif s.stance_s <= LONGEST_STANCE_S:
        c.count += 1
        for i in range(3):
            c.change[i] += s.acc_n[i] * r.dt
            change = c.change[i] - s.stance_vel[i] + c.first[i]
            c.total[i] += change
            c.squares[i] += change * change


@inlined
def judge_innovation(s: Any, r: Any, vel: int, variance: float) -> None:
    """Compare the velocity at the first sample of a stance with what P and R (``variance``) expect.

    Call it before the update. ``vel`` is the first error state of the velocity, ``s.stance_vel`` what the standing
    foot's is taken for.
    """
    _note_creep(s, r)
    if s.stance_s > r.dt:
        return
    # eᵀ (P + R)⁻¹ e by Cholesky's columns: the whole of P, so that no heading of the sensor counts for another
    P = s.P
    e0, e1, e2 = s.vel[0] - s.stance_vel[0], s.vel[1] - s.stance_vel[1], s.vel[2] - s.stance_vel[2]
    d0 = P[vel, vel] + variance
    l10, l20 = P[vel + 1, vel] / d0, P[vel + 2, vel] / d0
    d1 = P[vel + 1, vel + 1] + variance - l10 * l10 * d0
    l21 = (P[vel + 2, vel + 1] - l20 * l10 * d0) / d1
    d2 = P[vel + 2, vel + 2] + variance - l20 * l20 * d0 - l21 * l21 * d1
    y1 = e1 - l10 * e0
    y2 = e2 - l20 * e0 - l21 * y1
    square = e0 * e0 / d0 + y1 * y1 / d1 + y2 * y2 / d2
    s.verdict.n_judged += 1
    if square > SURPRISE:
        s.verdict.n_surprising += 1


@compiled
def _land(s: Any, out: FloatArray) -> None:
    """At the first still sample after a swing: write the step from the previous landing, if long enough."""
    steps, verdict, pos = s.steps, s.verdict, s.pos
    x, y, z = pos[0] - steps.landing[0], pos[1] - steps.landing[1], pos[2] - steps.landing[2]
    verdict.n_landings += 1
    length = math.sqrt(x * x + y * y + z * z)
    verdict.longest_stride = max(verdict.longest_stride, length)
    if length > LONGEST_STRIDE_M:
        verdict.n_long_strides += 1
    if steps.swing < steps.min_s or math.sqrt(x * x + y * y + z * z) < steps.min_m:
        return
    out[STEP] = steps.swing
    out[STEP + 1] = steps.count
    out[STEP + 2] = math.sqrt(x * x + y * y)
    out[STEP + 3] = z
    out[STEP + 4] = math.atan2(y, x)
    steps.count += 1
    verdict.steps_m += length
    s.creep.along[0], s.creep.along[1] = x, y
    horizontal = math.sqrt(x * x + y * y)
    for i in range(2):
        s.creep.along[i] /= max(horizontal, 1e-9)
    for i in range(3):
        steps.landing[i] = pos[i]
        s.forward[i] += s.rot[0, i] * x + s.rot[1, i] * y


@inlined
def emit_sigma(s: Any, pos: int, vel: int, att: int, out: FloatArray) -> None:
    """Write the standard deviations of position, velocity and attitude, by their first error states.

    Three errors are considered, not estimated. ``s.unknown_bias`` is the variance of a gyroscope bias that is no
    error state: what it does to heading and horizontal position is added (every stance takes its effect on the
    tilt out). ``s.unknown_tilt`` is the variance of the tilt at which a standing accelerometer with a bias seems
    level: no stance can take that out; an accelerometer that is off by as much of gravity makes every way
    longer or shorter by that share. ``s.creep`` is what the standing foot's velocity leaves open: it moves the
    position on for as long as the foot walks.
    """
    c = s.creep
    creep_xy = 0.5 * (c.variance[0] + c.variance[1]) if s.tilt > 0.0 else 0.0
    creep_z = c.variance[2] if s.tilt > 0.0 else 0.0
    for i in range(3):
        if s.started:
            position, attitude = s.P[pos + i, pos + i], s.P[att + i, att + i]
            position += s.unknown_tilt * s.pos[i] * s.pos[i]
            if i < 2:
                position += s.unknown_bias * s.lean[i] * s.lean[i]
                attitude += s.unknown_tilt
                position += creep_xy * (c.way[0] * c.way[0] + c.way[1] * c.way[1])
            else:
                position += creep_z * c.time * c.time
                attitude += s.unknown_bias * s.verdict.navigated_s * s.verdict.navigated_s
            out[SIGMA + i] = math.sqrt(max(0.0, position))
            out[SIGMA + 3 + i] = math.sqrt(max(0.0, s.P[vel + i, vel + i]))
            out[SIGMA + 6 + i] = math.sqrt(max(0.0, attitude))
        else:
            out[SIGMA + i] = math.nan
            out[SIGMA + 3 + i] = math.nan
            out[SIGMA + 6 + i] = math.nan
    s.verdict.unsure_m = math.sqrt(out[SIGMA] * out[SIGMA] + out[SIGMA + 1] * out[SIGMA + 1])


@inlined
def emit_detector(r: Any, first: int, out: FloatArray) -> None:
    """Write the detector's statistics of the sample ``r`` to the end of the result."""
    for i in range(out.shape[0] - first):
        out[first + i] = r.statistic[i]


@inlined
def at_rest(s: Any, r: Any, since: float, rate: float) -> bool:
    """Return whether the foot has been still for ``since`` s and turns by less than ``rate`` rad/s at ``r``.

    The condition of a zero angular rate update; stricter than stance, for a walking foot rolls on as it
    stands.
    """
    x, y, z = r.gyr[0] - s.bias_gyr[0], r.gyr[1] - s.bias_gyr[1], r.gyr[2] - s.bias_gyr[2]
    return s.stance_s >= since and math.sqrt(x * x + y * y + z * z) < rate
