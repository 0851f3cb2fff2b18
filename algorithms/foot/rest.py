"""The rest from which a foot estimator starts.

Dissertation, section 3.6: gyroscope bias and level from the mean of a rest. It is verified, not assumed: it
is a stretch in which every sample stays within ``rest_acc`` and ``rest_gyr`` of the running mean, and whose
mean rate is small enough to be a bias.

``fixed`` (the source): the first such stretch that lasts ``init_s``. ``adaptive`` (ours): the first that lasts
``init_min_s``, taken to its end or to ``init_s``; a walk that begins in motion so starts in its first stance.
A foot that is about to walk turns before it moves: taken for a bias, that turns the whole walk. The bias is
therefore the mean rate of the rest's half seconds, each weighted by the inverse fourth power of its variance,
and its variance follows from theirs and the length (:func:`bias_of`). Of a rest of less than half a second
nothing is known but that it turns by no more than ``rest_gyr``. With a prior (``rest_bias_sigma``) the bias is
the posterior mean: what a restless rest says of it counts little. A rest that goes on beyond ``init_s`` is
listened to until the foot moves.

Where a stride's time has passed without a rest, the walk had begun before the recording did: an adaptive start then
takes the first stance that the detector finds (:func:`watch_stance`), with what such a stance leaves open.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type
from ..numerics.strapdown import level

LONGEST_PAUSE_S = 0.5
"""A longer time step interrupts a rest: nothing is known about what happened in it."""

PIECE_S = 0.125
PIECES = 4
"""Half seconds of a rest are looked at in steps of such pieces (s), so many at a time."""
LEAST_SPREAD = 1e-4
"""rad/s: no sensor is quieter; keeps weights finite."""
BIAS_CHANGE = 5e-4
"""rad/s: what a rest cannot show, the bias' change from rest to walk (0.03 °/s: instability of industrial MEMS)."""

STRIDE_S = 1.0
"""So long without a rest: the walk had begun before the recording did."""
STANCE_S = 0.04
"""Shortest stance that such a walk starts from."""
STANCE_TILT = 0.1
"""rad: the force on a foot that rolls through a stance is off the vertical by about so much, in running."""
STANCE_SPEED = 0.1
"""m/s: a foot moves on by about so much in a stance."""

PIECE = record_type(
    ("elapsed", "f8"),
    ("count", "i8"),
    ("total", "f8", (3,)),  # sum of ω
    ("squares", "f8"),  # sum of ‖ω‖²
)

REST = record_type(
    ("length", "f8"),  # wanted, s; of an adaptive rest the longest
    ("adaptive", "?"),
    ("shortest", "f8"),  # of an adaptive rest, s
    ("acc_max", "f8"),
    ("gyr_max", "f8"),
    ("bias_max", "f8"),
    ("gravity", "f8"),  # the parameter
    ("gravity_from_rest", "?"),
    ("takes_bias", "?"),  # else the gyroscope's bias stays in its readings
    ("count", "i8"),
    ("begin", "f8"),  # s since the first row
    ("elapsed", "f8"),  # s
    ("acc", "f8", (3,)),  # mean force, b
    ("gyr", "f8", (3,)),  # mean rate, b
    ("spread", "f8"),  # sum of ‖ω − running mean‖²
    ("longest", "f8"),  # longest rest seen, s
    ("index", "i8"),  # sample that completed the rest, −1 not yet
    ("moved", "i8"),  # samples after the rest that are not at rest
    ("moved_before", "i8"),  # samples before it that are not
    ("pieces", PIECE, (PIECES,)),  # the newest pieces of the rest, a ring
    ("n_pieces", "i8"),  # whole ones so far
    ("rate", "f8", (3,)),  # mean rate of the newest half second
    ("quietest", "f8"),  # variance of the rate in the quietest half second, rad²/s²; infinite without one
    ("bias_prior", "f8"),  # variance of an axis' bias before the rest is seen, rad²/s²; 0 unknown
    ("weights", "f8"),  # sum of the half seconds' weights
    ("weights_squared", "f8"),  # sum of their squares
    ("weighted", "f8", (3,)),  # weighted sum of their mean rates
    ("sway", "f8"),  # weighted sum of the variances of their pieces' means, an axis, rad²/s²
    ("bias_variance", "f8"),  # of an axis' bias after the rest, rad²/s²; 0 where it is not known
    ("lasts", "?"),  # it was long enough and still goes on
    ("heard_out", "?"),  # the foot has moved since: what the whole rest says is not taken over yet
    ("stance", "?"),  # taken from a stance: there was no rest
    ("swung", "?"),  # the detector has found a swing: what does not is no gait
    ("stance_s", "f8"),  # of the stance in progress
    ("stance_count", "i8"),
    ("stance_acc", "f8", (3,)),  # its mean force, b
)


@inlined
def _distance(a: Any, b: Any) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(x * x + y * y + z * z)


@inlined
def _is_near(rest: Any, r: Any) -> bool:
    """Return whether a sample is within the limits of the rest's mean."""
    return _distance(r.acc, rest.acc) <= rest.acc_max and _distance(r.gyr, rest.gyr) <= rest.gyr_max


@inlined
def _is_bias(rest: Any) -> bool:
    """Return whether the mean rate is small enough to be a bias."""
    x, y, z = rest.gyr[0], rest.gyr[1], rest.gyr[2]
    return math.sqrt(x * x + y * y + z * z) <= rest.bias_max


@compiled
def _clear(piece: Any) -> None:
    piece.elapsed = 0.0
    piece.count = 0
    piece.squares = 0.0
    for i in range(3):
        piece.total[i] = 0.0


@compiled
def _note(rest: Any, r: Any) -> None:
    """Take a sample of the rest into its present piece; weigh the half second that a full one ends."""
    now = rest.pieces[rest.n_pieces % PIECES]
    now.elapsed += r.dt
    now.count += 1
    now.squares += r.gyr_norm * r.gyr_norm
    for i in range(3):
        now.total[i] += r.gyr[i]
    if now.elapsed < PIECE_S:
        return
    rest.n_pieces += 1
    if rest.n_pieces >= PIECES:
        _weigh(rest)
    _clear(rest.pieces[rest.n_pieces % PIECES])


@compiled
def _weigh(rest: Any) -> None:
    """Add the mean rate of the newest half second, by its variance, to the weighted mean."""
    n = 0
    for k in range(PIECES):
        n += rest.pieces[k].count
    variance = 0.0
    for k in range(PIECES):
        variance += rest.pieces[k].squares / n
    sway = 0.0
    for i in range(3):
        rest.rate[i] = 0.0
        for k in range(PIECES):
            rest.rate[i] += rest.pieces[k].total[i] / n
        variance -= rest.rate[i] * rest.rate[i]
        for k in range(PIECES):
            off = rest.pieces[k].total[i] / rest.pieces[k].count - rest.rate[i]
            sway += off * off / (3 * (PIECES - 1))
    variance = max(variance, 0.0)
    rest.quietest = min(rest.quietest, variance)
    square = (variance + LEAST_SPREAD * LEAST_SPREAD) * (variance + LEAST_SPREAD * LEAST_SPREAD)
    weight = 1.0 / (square * square)
    rest.weights += weight
    rest.weights_squared += weight * weight
    rest.sway += weight * sway
    for i in range(3):
        rest.weighted[i] += weight * rest.rate[i]


@compiled
def bias_of(rest: Any, bias: Any) -> None:
    """Write the gyroscope's bias as the rest shows it to ``bias`` and its variance into the rest."""
    if rest.quietest < math.inf:
        # So many half seconds that overlap by three quarters count.
        n = rest.weights * rest.weights / rest.weights_squared
        length = PIECE_S * (PIECES + n - 1.0)
        # The sway of a standing foot lasts for about half a second: so far apart its means are independent.
        variance = rest.sway / rest.weights * PIECES * PIECE_S / length + BIAS_CHANGE * BIAS_CHANGE
        for i in range(3):
            bias[i] = rest.weighted[i] / rest.weights
    else:
        variance = (
            rest.gyr_max * rest.gyr_max / 3.0 if not rest.stance else rest.bias_max * rest.bias_max / 3.0
        )
        for i in range(3):
            bias[i] = rest.gyr[i]
    if rest.bias_prior > 0.0:
        trust = rest.bias_prior / (rest.bias_prior + variance)
        variance *= trust
        for i in range(3):
            bias[i] *= trust
    rest.bias_variance = variance


@inlined
def watch(rest: Any, r: Any, k: int, time: float) -> bool:
    """Take sample ``k`` at ``time`` into the search for a rest; return True where it completes it."""
    if rest.index >= 0:
        if not _is_near(rest, r):
            rest.moved += 1
            rest.heard_out = rest.lasts
            rest.lasts = False
        elif rest.lasts:
            rest.elapsed += r.dt
            _note(rest, r)
        return False
    dt = r.dt
    if rest.count > 0 and (dt > LONGEST_PAUSE_S or not _is_near(rest, r)):
        if (
            rest.adaptive
            and rest.elapsed + 5e-10 >= rest.shortest
            and dt <= LONGEST_PAUSE_S
            and _is_bias(rest)
        ):
            rest.index = k
            return True
        rest.moved_before += rest.count
        rest.count = 0
    if rest.count == 0:
        rest.begin = time
        rest.elapsed = 0.0
        rest.spread = 0.0
        if rest.adaptive:
            rest.quietest = math.inf
            rest.n_pieces = 0
            rest.weights = 0.0
            rest.weights_squared = 0.0
            rest.sway = 0.0
            for i in range(3):
                rest.weighted[i] = 0.0
            _clear(rest.pieces[0])
        for i in range(3):
            rest.acc[i] = 0.0
            rest.gyr[i] = 0.0
        dt = 0.0
    rest.count += 1
    rest.elapsed += dt
    for i in range(3):
        rest.acc[i] += (r.acc[i] - rest.acc[i]) / rest.count
        rest.gyr[i] += (r.gyr[i] - rest.gyr[i]) / rest.count
    spread = _distance(r.gyr, rest.gyr)
    rest.spread += spread * spread
    if rest.adaptive:
        _note(rest, r)
    rest.longest = max(rest.longest, rest.elapsed)
    # Half a nanosecond of grace: time steps are rounded differences.
    if rest.elapsed + 5e-10 < rest.length:
        return False
    if not _is_bias(rest):
        rest.moved_before += rest.count
        rest.count = 0  # a steady turn, not a rest
        return False
    rest.index = k
    rest.lasts = rest.adaptive
    return True


@compiled
def watch_stance(rest: Any, r: Any, k: int, time: float) -> None:
    """Take the sample ``k`` with its decision; without a rest, let the walk start in the first long enough stance.

    The rest is looked for ahead of the decisions, by the detector's latency: one in progress goes before.
    """
    if not r.still:
        rest.swung = True
        rest.stance_s = 0.0
        rest.stance_count = 0
        return
    rest.stance_s += r.dt
    rest.stance_count += 1
    for i in range(3):
        rest.stance_acc[i] += (r.acc[i] - rest.stance_acc[i]) / rest.stance_count
    is_stance = rest.swung and time >= STRIDE_S and rest.stance_s >= STANCE_S
    if not is_stance or rest.elapsed + 5e-10 >= rest.shortest:
        return
    rest.stance = True
    rest.index = k
    rest.begin = time - rest.stance_s
    rest.elapsed = rest.stance_s
    rest.count = rest.stance_count
    rest.spread = 0.0
    rest.quietest = math.inf
    for i in range(3):
        rest.acc[i] = rest.stance_acc[i]
        rest.gyr[i] = 0.0  # a turning foot says nothing of the bias


@compiled
def hear_out(s: Any) -> None:
    """Take over the bias that the whole of a long rest shows, for a filter that estimates none itself."""
    s.rest.heard_out = False
    if s.rest.takes_bias:
        bias_of(s.rest, s.bias_gyr)
        s.unknown_bias = s.rest.bias_variance
        for i in range(3):
            s.verdict.first_bias[i] = s.bias_gyr[i]


@compiled
def start(s: Any) -> None:
    """Level the navigation of ``s`` by its rest, take over bias and gravity."""
    rest = s.rest
    x, y, z = rest.acc[0], rest.acc[1], rest.acc[2]
    gravity = math.sqrt(x * x + y * y + z * z) if rest.gravity_from_rest else rest.gravity
    level(s, rest.acc, rest.gyr, gravity)
    if rest.adaptive:
        bias_of(rest, s.bias_gyr)
    if not rest.takes_bias:
        for i in range(3):
            s.bias_gyr[i] = 0.0
