"""Aids beside the zero velocity: height on flat ground, straight walking, magnetometer, barometer.

All are off by default and then change no bit. A filter with position and attitude errors calls :func:`aid`
after its zero-velocity update; every aid is one scalar measurement of an error state, taken by
:func:`..numerics.kalman.update`, so cross-covariances carry it to the other states (a heading error shifts
the position, too). A height leaves attitude and gyroscope bias alone (they are considered, after Schmidt):
its error is mostly the accelerometer's, which the filters do not model, and blaming the tilt for it would
turn the heading by degrees. Aids act in stance only, once a foot has stood for ``aid_after_s``; so one stance is
one measurement of height and of heading, not as many as it has samples.

Height update on flat ground ("HUPT"): where a stance is within ``hupt_max_m`` of the height of the one
before, both are on one level, and the height of the level's first stance is measured. Otherwise the foot has
climbed: nothing is measured, and a new level begins. After Abdulrahim, Hide, Moore, Hill 2012, "Using
constraints for shoe mounted indoor pedestrian navigation", Journal of Navigation 65(1); ours: the reference
is the level's first stance, not the one before, whose remaining error would add up.

Straight walking: the last ``straight_strides`` strides were long enough, and the directions of their
displacements lie within ``straight_max_deg`` of their mean. Then the newest direction ψ measures the heading
error, with the standard deviation ``sigma_heading`` / (1 − spread / ``straight_max_deg``): the less straight,
the less it counts.

- ``hdr``: error = ψ − mean direction of the straight so far. After Borenstein and Ojeda 2009, "Heuristic
  reduction of gyro drift for personnel tracking systems", Journal of Navigation 62(1), in the Kalman form of
  Jiménez, Seco, Prieto, Guevara 2010, "Indoor pedestrian navigation using an INS/EKF framework for yaw drift
  reduction and a foot-mounted IMU" (WPNC), where the reference is the mean of the two strides before.
- ``ihde``: error = ψ − the nearest dominant direction of the building, if within ``heading_gate_deg``. After
  Jiménez, Seco, Zampella, Prieto, Guevara 2011, "Improved heuristic drift elimination (iHDE) for pedestrian
  navigation in complex buildings" (IPIN). Ours: where a shoe's sensor points is not known, so the directions
  are laid along the first straight (``heading_grid``), which itself is treated as ``hdr``; and the function
  that gives the confidence.

Magnetometer: direction of the horizontal field in n against that of the first stance; taken where norm and
dip are like there. It needs a calibrated sensor in the axes of the IMU. Barometer: height over the first
stance by the standard atmosphere (ISO 2533), h = T/Λ (1 − (p/p₀)^(RΛ/gM)), Λ = 0.0065 K/m, R = 8.314462618
J/(mol K), M = 0.0289644 kg/mol, g = 9.80665 m/s².
"""

from .estimator import AidedEstimator
from .parameters import AidingParams
from .record import AIDS
from .stance import aid

__all__ = ["AIDS", "AidedEstimator", "AidingParams", "aid"]
