"""Zero of a chain's flexions, and the standard deviations that are stated of them."""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled
from ..numerics.rotations import near
from .mounting import GUESS_DEG, NOTHING, guess_deg

GUESS = math.radians(GUESS_DEG)


@compiled
def set_zero(s: Any) -> None:
    """Learn the zero of every flexion during the first ``zero_s`` seconds (running mean)."""
    s.zero_time += s.dt
    if s.zero == 0 or s.zero_time > s.zero_s:
        return
    for j in range(s.n - 1):
        if s.valid[j] == 0 or s.valid[j + 1] == 0:
            continue
        target = 0.0 if s.zero == 1 else s.enc[j]
        if math.isfinite(target):
            mean = s.zero_sum[j] / max(1, s.zero_count[j])
            s.zero_sum[j] += near(s.angle[j, 0] - target, mean)
            s.zero_var[j] += s.angle_sd[j] ** 2
            s.zero_count[j] += 1


@compiled
def stated_sd(s: Any, j: int) -> float:
    """Return the standard deviation of flexion ``j`` with what does not change with time: zero and accelerometers."""
    scale = innovation_scale(s, j)
    zero = s.mount_var if s.zero == 0 or s.zero_count[j] == 0 else scale * s.zero_var[j] / s.zero_count[j]
    angle = s.angle[j, 0] - s.zero_sum[j] / max(1, s.zero_count[j])
    return math.sqrt(scale * s.angle_sd[j] ** 2 + zero + s.tilt_var + axis_var(s, angle))


@compiled
def axis_unknown(s: Any) -> bool:
    """Return whether the hinge's axis is neither stated nor found (of a chain of joints: never)."""
    return s.guessed[0] == 2 or s.guessed[1] == 2


@compiled
def angle_unknown(s: Any) -> bool:
    """Return whether there is no angle: about an axis that is not known, or of unknown sign and zero."""
    guessed = s.guessed[0] == 1 or s.guessed[1] == 1
    return axis_unknown(s) or (s.sign_by == NOTHING and guessed)


@compiled
def axis_var(s: Any, angle: float) -> float:
    """Return the variance of ``angle`` from an axis that is not known well, or of unknown sign (truth ±angle).

    A stated axis that was not found is worth what the sensors turn about it: nothing is added on a robot's plain hinge.
    """
    loose = (2.0 - s.about[0] - s.about[1]) * GUESS * GUESS
    return loose + (2.0 * angle * angle if s.sign_by == NOTHING else 0.0)


@compiled
def innovation_scale(s: Any, j: int) -> float:
    """Return by what the filter's variance of joint ``j`` is multiplied: innovations as they are over as assumed.

    A rigid chain fits better than ``sd_joint`` says, a leg with soft tissue worse (0.1 to 0.5, and 4 to 5).
    """
    return min(10.0, max(0.1, s.misfit[j]))


@compiled
def spread_of_zero(s: Any) -> None:
    """Write the variance of a hinge's zero by the mountings; a guessed long axis is known less well."""
    s.mount_var = 0.0
    guess = math.radians(guess_deg(s.sign_by, s.guessed[0] == 1 and s.guessed[1] == 1))
    for i in range(2):
        sd = max(s.sd_mount, guess) if s.guessed[i] == 1 else s.sd_mount
        s.mount_var += sd * sd
