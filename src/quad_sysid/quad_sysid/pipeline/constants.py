"""What decides whether records are answered, and what an answer claims or advises.

The verdict's and the search's are in discover/constants.py; what decides about feedback, which one
file does, stands there (selection.py).
"""

# whether there is anything to answer

LEAST_WINDOWS = 8
"""Training windows of 0.5 s below which a fit has too few independent errors."""
THROUGHOUT = 0.9
"""Share of a segment with all motors at their limits that leaves nothing to learn from."""
CLIPPED = 0.1
"""Share that a gyro may spend at its limit: the fit leaves these samples out and would hold to
0.3, but the errors include them."""
MOTION = 1.5
"""Error of holding the last rate over the measurement noise, below which nothing moved."""

# where a model is trusted

COHERENT = 0.6
"""Squared coherence above which a frequency supports the model: noise explains less than half."""
Z99 = 2.576
"""Standard errors of a 99 % interval, drawn and required."""
HALF_POWER = 0.41
"""Part by which a gain may be off in the trusted band, 3 dB."""
PAPERS_BAND = (0.1, 20.0)
"""The band that the paper's PRBS covers, rad/s; what a model does not cover of it is stated."""
BEYOND = 0.05
"""Share of the range of the training by which a signal must leave it: the ends are percentiles."""
FURTHER = 1.5
"""Factor by which held-out rates exceed the training's where extrapolation is named."""

# what is named

RIVAL = 0.05
"""Probability above which a rival effect calls for a flight that separates it; below it the effect
is certain by the 95 % that such a flight is designed for."""
PEAK = 6.0
"""Least power of a peak over its surroundings, whatever its significance."""
