"""Numbers by which several modules decide what an answer claims, shows or advises.

The verdict's and the search's are in discover/constants.py.
"""

COHERENT = 0.6
"""Squared coherence above which a frequency supports the model: noise explains less than half."""
Z99 = 2.576
"""Half-width of a 99 % interval, standard errors."""
GUSTY = 5.0
"""Multiple of the rate's noise above which an error without a cause is said to be taken for gusts:
in calm air half a second's free run collects two or three times the noise."""
RIVAL = 0.05
"""Probability of a rival effect above which a flight that separates it is advised."""
