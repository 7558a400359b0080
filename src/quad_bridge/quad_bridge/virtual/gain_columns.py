"""Columns of the firmware's gain table, one row per axis; all SI. No arithmetic here.

The cascade's stand in control.py's docstring, as the schedule on the voltage does, the state
feedback's in state_feedback.py's.
"""

ANGLE_KP, KP, KI, KD, RATE_LIMIT, OUTPUT_LIMIT, INTEGRATOR_LIMIT, D_FILTER_HZ = range(8)
(
    LQR_SHARE, LQR_ANGLE, LQR_RATE, LQR_DRIVE, LQR_INTEGRAL, LQR_GAIN, LQR_LAG_S, LQR_DELAY_S,
    LQR_DAMPING, LQR_OBSERVER,
) = range(8, 18)  # fmt: skip
SAG_EXPONENT, SAG_VOLTS = 18, 19
COLUMNS = 20
