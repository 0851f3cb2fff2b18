"""Where everything lies in the packed float64 state that the foot estimators share.

A state is three stretches: the core below (configuration, counters, rest initialisation, navigation, steps),
the filter's own numbers (from ``CORE`` on; each estimator's module allocates them with :class:`Allocator`),
and a ring of the newest samples (offset in ``RING``). All offsets are module constants, so numba compiles
them in; only the ring's place and length depend on parameters. Copying the buffer is a snapshot, writing it
back is a seek.
"""

from __future__ import annotations


class Allocator:
    """Hand out consecutive offsets: ``take(9)`` returns where the next nine numbers lie."""

    def __init__(self, start: int = 0) -> None:
        self.size = start

    def __call__(self, count: int = 1) -> int:
        """Return the offset of ``count`` new entries."""
        offset = self.size
        self.size += count
        return offset


_take = Allocator()

# Detector: configuration (see detectors.py)
KIND = _take()  # index into detectors.KINDS
W_LO = _take()  # samples of the statistic's window before the sample that it speaks of
W_HI = _take()  # samples after it
CLEANING = _take()  # index into detectors.CLEANINGS
C_LEN = _take()  # length of the cleaning window, samples
C_LO = _take()
C_HI = _take()  # look-ahead of the cleaning, samples
LATENCY = _take()  # W_HI + C_HI
LIMITS = _take(4)  # thresholds, by kind
WEIGHT_ACC = _take()  # 1/σa² of SHOE
WEIGHT_GYR = _take()  # 1/σω² of SHOE
PITCH_TAU = _take()
RING = _take()
RING_MASK = _take()  # length − 1; the length is a power of two

# Counters
TAKEN = _take()  # rows taken
DECIDED = _take()  # row up to which the detector's stages have come; runs past the end in a flush
RELEASED = _take()  # samples handed to the filter
LAST_ONE = _take()  # newest raw "still" at or before the sample being filled, −1 none
RAW_COUNT = _take()  # raw "still" in the median's window, counted as samples enter and leave it
BURST_START = _take()  # first sample of the run of filled "still" that is being cleaned
TIME = _take()  # s since the first row, at the newest row
TIME_OUT = _take()  # s since the first row, at the released sample
REPAIRED = _take()  # rows with a value that was not finite (held)
ROW_MIN = _take(6)
ROW_MAX = _take(6)

# Rest initialisation: configuration, then state (see strapdown.py)
INIT_S = _take()
REST_ACC = _take()
REST_GYR = _take()
REST_BIAS = _take()
GRAVITY_PARAM = _take()
GRAVITY_FROM_REST = _take()
TRAPEZOID = _take()
REST_COUNT = _take()
REST_START = _take()
REST_ELAPSED = _take()
REST_MEAN = _take(6)  # acceleration, angular rate
REST_SPREAD = _take()  # sum of ‖ω − running mean‖²
REST_BEST = _take()  # longest rest seen, s
INIT_INDEX = _take()  # sample that completed the rest, −1 not yet
INIT_START = _take()
INIT_MEAN = _take(6)
TILT = _take(3)  # the pitch detector's gravity direction in the sensor frame
PITCH_REF = _take()
MOVED = _take()  # samples after the rest that are not at rest

# Navigation
STARTED = _take()
GRAVITY = _take()
ROT = _take(9)  # rot_nb, row by row
VEL = _take(3)
POS = _take(3)
ACC_N = _take(3)  # specific force in n of the newest interval, without gravity added
ACC_OLD = _take(3)  # acceleration in n at the previous sample
BIAS_GYR = _take(3)
BIAS_ACC = _take(3)
STILL_COUNT = _take()
STANCE_S = _take()  # s that the foot has been still without a break, at the released sample

# Steps
STEP_MIN_S = _take()
STEP_MIN_M = _take()
STEP_INDEX = _take()
STEP_LAND = _take(3)
STEP_SWING = _take()  # s since the newest still sample
STEP_WAS_STILL = _take()

CORE = _take.size

# One sample in the ring
R_DT = 0
R_ACC = 1
R_GYR = 4
R_EXTRA = 7  # magnetometer (3), pressure (1): NaN where none arrived
R_NORM_ACC = 11
R_NORM_GYR = 12
R_PITCH = 13  # degrees
R_STAT = 14
R_RAW = 17
R_FILLED = 18
R_STILL = 19
RECORD = 20

# The result vector
O_POSE = 0
O_VEL = 7
O_STILL = 10
O_STEP = 11
O_REST = 16  # sigma, where the estimator has it, then the detector's statistics
