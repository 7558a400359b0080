"""What a training must show before an effect that lives by it is tried at all.

The search decides what then is believed (discover/constants.py); priors stand beside each effect.
"""

MOVES = 0.02
"""Share of its mean by which the throttle must scatter, or of this axis' command the product of
the others', for the curvature of thrust to show: below it, curvature is one more gain."""
SLOW_MOVES = 0.01
"""Share of its mean by which throttle or voltage must move to support a curve over it."""
VOLTAGE_MOVES = 0.002
"""Relative change of the voltage, some 20 mV of 12 V, below which a voltmeter shows its steps."""
SAG_SHOWS = 0.05
"""Relative change of the voltage that shows its effect surely; a smaller one only a strong one."""
LEAST_CLIMB_M = 0.1
"""Change of the altitude below which no ground effect shows: it fades over about a radius."""
MOST_MOTORS = 12
"""Motors that may each have an effect of their own: the largest frames that fly."""
