"""Below what a double's 16 digits leave nothing, for all fits of black-box models.

What decides about a model stands where it is used.
"""

ROUNDING = 1e-13
"""Relative size, beside columns of length 1, below which a direction is rounding; its inverse is
the condition from which on a solution keeps no digits that can be trusted."""
EXACT = 1e-18
"""Part of the output's power below which a residual is rounding, as with data free of noise."""
