"""How far a joint's servo loop is from instability."""

from __future__ import annotations

import numpy as np

FREQUENCIES = np.geomspace(1e-2, 1e5, 20000)  # rad/s

# Least phase margin that a drive can live with: Astrom and Murray, Feedback Systems, 2008, section
# 11.3, has 30 to 60 degrees.
PHASE_MARGIN_MIN_DEG = 30.0


def phase_margin_deg(kp: float, kd: float, ki: float, inertia: float, lag_s: float) -> float:
    """Phase margin [deg] of PID around an inertia, SI at the joint, rotary or linear.

    kd: the servo's and the back-EMF's together; lag_s: of sampling, half a hold and half a
    difference, so one servo period. Where the loop's gain crosses one more than once, the last
    crossing counts. Without gains there is nothing to be unstable: 180.
    """
    w = FREQUENCIES
    gains = kp + kd * 1j * w + ki / (1j * w)
    above = np.nonzero(np.abs(gains) > inertia * w**2)[0]
    if not len(above):
        return 180.0
    last = above.max()
    return float(np.degrees(np.angle(gains[last]) - w[last] * lag_s))
