"""Several sensors and an encoder on one time line: samples at the times of the first segment's sensor.

Sensors run at their own rates and clocks. Each stream keeps its newest messages with the running integral of its
angular rate (trapezoid over its own samples). A sample of the first segment is due once every other stream
has reached its time; it then holds, of each segment, the specific force and rate interpolated to that time and
the turn since the sample before (the difference of the integrals, so that a faster sensor loses nothing).
A stream that stays behind by more than ``hold_s`` is missing in that sample; nothing is extrapolated, and nothing
is interpolated over more than ``gap_s``.

With ``lookahead`` 2 a sample is given out when two more are known, with the derivative of each rate by
(g[k−2] − 8 g[k−1] + 8 g[k+1] − g[k+2])/(12 T) (section 3.1 of the source does not define it); with 0 at once, with
(3 g[k] − 4 g[k−1] + g[k−2])/(2 T).
"""

from __future__ import annotations

from typing import Any

from ..contract import FloatArray
from ..numerics.compiled import compiled
from . import handedness

SEGMENTS = ("trunk", "thigh", "shank", "foot")
JOINTS = ("hip", "knee", "ankle")
"""Joint j lies between segments j and j + 1."""

STREAMS = 5
ENCODER = 4
RING = 64
LINE = 5
MOST = 4
"""Segments at most."""
NEVER = -(2**62)
STUCK_NS = 1_000_000_000
"""No living sensor repeats force and rate to the last digit for so long: its noise moves them."""
REST_RATE, REST_FORCE = 0.2, 1.0
"""Rate (rad/s, with a consumer's bias) and force besides gravity (m/s²) of a sensor that may as well be at rest."""

FIELDS: list[Any] = [
    ("n", "i8"),  # segments attached; they are numbered 0 … n − 1 from top to bottom
    ("on", "i8", (STREAMS,)),
    ("stream", "i8", (8,)),  # of an input's index
    ("hold_ns", "i8"),
    ("gap_ns", "i8"),
    ("lookahead", "i8"),
    ("ending", "i8"),
    ("count", "i8", (STREAMS,)),
    ("ring_t", "i8", (STREAMS, RING)),
    ("ring", "f8", (STREAMS, RING, 9)),  # force, rate, integral of the rate; encoder: angles
    ("due", "i8"),
    ("newest", "i8"),
    ("first", "i8"),
    ("look", "f8", (9,)),
    ("sum", "f8", (MOST, 3)),
    ("seen", "i8", (MOST,)),  # time of the last valid sample of each segment
    ("missed", "i8", (STREAMS,)),
    ("dead", "i8", (MOST,)),  # samples in which acceleration and rate are exactly 0
    ("stuck", "i8", (MOST,)),  # messages that repeat the one before for too long
    ("stuck_moving", "i8", (MOST,)),  # those of them that are no reading of a sensor at rest
    ("same_since", "i8", (MOST,)),
    ("samples", "i8"),
    ("given", "i8"),
    ("line_t", "i8", (LINE,)),
    ("line_dt", "f8", (LINE,)),
    ("line_acc", "f8", (LINE, MOST, 3)),
    ("line_gyr", "f8", (LINE, MOST, 3)),
    ("line_turn", "f8", (LINE, MOST, 3)),
    ("line_gap", "f8", (LINE, MOST)),
    ("line_valid", "i8", (LINE, MOST)),
    ("line_enc", "f8", (LINE, 3)),
    # The sample given out.
    ("now", "i8"),
    ("dt", "f8"),
    ("acc", "f8", (MOST, 3)),
    ("gyr", "f8", (MOST, 3)),
    ("turn", "f8", (MOST, 3)),
    ("dgyr", "f8", (MOST, 3)),
    ("slope", "i8", (MOST,)),  # whether dgyr is known
    ("gap", "f8", (MOST,)),  # seconds lost before this sample, 0 if none
    ("valid", "i8", (MOST,)),
    ("enc", "f8", (3,)),
    *handedness.FIELDS,
]


@compiled
def push(s: Any, index: int, t: int, values: FloatArray) -> None:
    """Take a message of input ``index`` into its ring."""
    i = s.stream[index]
    k = s.count[i]
    if k > 0 and t <= s.ring_t[i, (k - 1) % RING]:
        return
    s.newest = max(s.newest, t)
    if i != ENCODER:
        count_repeats(s, i, t, values)
    a = k % RING
    s.ring_t[i, a] = t
    if i == ENCODER:
        for j in range(3):
            s.ring[i, a, j] = values[j]
    else:
        for j in range(6):
            s.ring[i, a, j] = values[j]
        b = (k - 1) % RING
        dt = 0.0
        if k > 0 and t - s.ring_t[i, b] <= s.gap_ns:
            dt = 1e-9 * (t - s.ring_t[i, b])
        for j in range(3):
            s.ring[i, a, 6 + j] = (
                s.ring[i, b, 6 + j] + 0.5 * dt * (s.ring[i, b, 3 + j] + values[3 + j]) if k > 0 else 0.0
            )
    s.count[i] = k + 1


@compiled
def count_repeats(s: Any, i: int, t: int, values: FloatArray) -> None:
    """Count the message of sensor ``i`` as stuck if it has said exactly this for longer than STUCK_NS."""
    same = s.count[i] > 0
    if same:
        b = (s.count[i] - 1) % RING
        for j in range(6):
            if s.ring[i, b, j] != values[j]:
                same = False
                break
    if not same:
        s.same_since[i] = t
    elif t - s.same_since[i] > STUCK_NS:
        s.stuck[i] += 1
        force = (values[0] ** 2 + values[1] ** 2 + values[2] ** 2) ** 0.5
        rate = (values[3] ** 2 + values[4] ** 2 + values[5] ** 2) ** 0.5
        if rate > REST_RATE or abs(force - 9.81) > REST_FORCE:
            s.stuck_moving[i] += 1


@compiled
def look(s: Any, i: int, t: int, width: int) -> bool:
    """Interpolate stream ``i`` at ``t`` into ``s.look``; False where that cannot be done."""
    oldest = max(0, s.count[i] - RING)
    k = s.count[i] - 1
    while k >= oldest and s.ring_t[i, k % RING] > t:
        k -= 1
    if k < oldest:
        return False
    a = k % RING
    if s.ring_t[i, a] == t:
        for j in range(width):
            s.look[j] = s.ring[i, a, j]
        return True
    if k + 1 >= s.count[i]:
        return False
    b = (k + 1) % RING
    span = s.ring_t[i, b] - s.ring_t[i, a]
    if span > s.gap_ns:
        return False
    w = (t - s.ring_t[i, a]) / span
    for j in range(width):
        s.look[j] = s.ring[i, a, j] + w * (s.ring[i, b, j] - s.ring[i, a, j])
    return True


@compiled
def gather(s: Any, t: int) -> None:
    """Put the sample at time ``t`` at the end of the line."""
    a = s.samples % LINE
    b = (s.samples - 1) % LINE
    s.line_t[a] = t
    s.line_dt[a] = 1e-9 * (t - s.line_t[b]) if s.samples > 0 else 0.0
    for i in range(s.n):
        s.line_valid[a, i] = 0
        s.line_gap[a, i] = 0.0
        if look(s, i, t, 9):
            fresh = s.seen[i] <= NEVER
            if not fresh and (s.seen[i] != s.line_t[b] or t - s.seen[i] > s.gap_ns):
                s.line_gap[a, i] = 1e-9 * (t - s.seen[i])
            for j in range(3):
                s.line_acc[a, i, j] = s.look[j]
                s.line_gyr[a, i, j] = s.look[3 + j]
                s.line_turn[a, i, j] = 0.0 if fresh else s.look[6 + j] - s.sum[i, j]
                s.sum[i, j] = s.look[6 + j]
            s.seen[i] = t
            s.line_valid[a, i] = 1
        else:
            s.missed[i] += 1
            for j in range(3):
                s.line_turn[a, i, j] = 0.0
    for j in range(3):
        s.line_enc[a, j] = float("nan")
    if s.on[ENCODER] == 1:
        if look(s, ENCODER, t, 3):
            for j in range(3):
                s.line_enc[a, j] = s.look[j]
        else:
            s.missed[ENCODER] += 1
    s.samples += 1


@compiled
def give(s: Any) -> bool:
    """Load the sample that is due into ``s.acc`` … where there is one."""
    if s.given >= s.samples or (s.ending == 0 and s.given + s.lookahead >= s.samples):
        return False
    k = s.given
    s.given += 1
    a = k % LINE
    s.now = s.line_t[a]
    s.dt = s.line_dt[a]
    first = k - 2
    last = k + 2 if s.lookahead == 2 else k
    whole = first >= 0 and last < s.samples
    span = 1e-9 * (s.line_t[last % LINE] - s.line_t[first % LINE]) if whole else 0.0
    if span <= 0.0 or span > 4e-9 * s.gap_ns:
        whole = False
    for j in range(3):
        s.enc[j] = s.line_enc[a, j]
    for i in range(s.n):
        s.valid[i] = s.line_valid[a, i]
        s.gap[i] = s.line_gap[a, i]
        s.slope[i] = 1 if whole else 0
        force, rate = 0.0, 0.0
        for j in range(3):
            force += abs(s.line_acc[a, i, j])
            rate += abs(s.line_gyr[a, i, j])
        if s.valid[i] == 1 and force == 0.0 and rate == 0.0:
            s.dead[i] += 1
        if whole:
            for m in range(first, last + 1):
                if s.line_valid[m % LINE, i] == 0:
                    s.slope[i] = 0
        for j in range(3):
            s.acc[i, j] = s.line_acc[a, i, j]
            s.gyr[i, j] = s.line_gyr[a, i, j]
            s.turn[i, j] = s.line_turn[a, i, j]
            s.dgyr[i, j] = 0.0
            if s.slope[i] == 1:
                g2, g1 = s.line_gyr[first % LINE, i, j], s.line_gyr[(k - 1) % LINE, i, j]
                if s.lookahead == 2:
                    h1, h2 = s.line_gyr[(k + 1) % LINE, i, j], s.line_gyr[last % LINE, i, j]
                    s.dgyr[i, j] = (g2 - 8.0 * g1 + 8.0 * h1 - h2) / (3.0 * span)
                else:
                    s.dgyr[i, j] = (3.0 * s.gyr[i, j] - 4.0 * g1 + g2) / span
        if s.valid[i] == 1:
            handedness.look(s, i)
    handedness.keep(s)
    return True


@compiled
def advance(s: Any) -> bool:
    """Give out the next sample, if one is due now."""
    if s.due < s.count[0]:
        backlog = s.count[0] - s.due
        t = s.ring_t[0, s.due % RING]
        ready = s.ending == 1 or backlog > RING // 2 or s.newest - t > s.hold_ns
        if not ready:
            ready = True
            for i in range(1, STREAMS):
                if s.on[i] == 1 and (s.count[i] == 0 or s.ring_t[i, (s.count[i] - 1) % RING] < t):
                    ready = False
        if ready:
            gather(s, t)
            s.due += 1
            return give(s)
    return s.ending == 1 and give(s)
