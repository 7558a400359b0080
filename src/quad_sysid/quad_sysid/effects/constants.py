"""Numbers by which several modules decide whether a training supports an effect.

The search decides what then is believed (discover/constants.py); priors stand beside each effect.
"""

SLOW_MOVES = 0.01
"""Least change of a slow signal, as a share of its size, for a curve over it or a memory of it."""
SAG_SHOWS = 0.05
"""Relative change of the voltage that shows its effect surely; a smaller one only a strong one."""
