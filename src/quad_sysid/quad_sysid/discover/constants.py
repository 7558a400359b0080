"""What decides in the search and the verdict, with its reasons; no effect has a rule of its own.

Priors of parameters stand beside each effect, those of the noise in model/structure.py; numerical
steps, the base's starts and the bands of lines where they are used.
"""

# what is believed before the data

EXPECTED = 0.05
"""Prior probability that an effect is missing, divided equally among the laws that can be tried,
and within each law among its variants (line or curve, motors, other axes). The 5 % of a test."""

# how far the search goes: more costs time only

BEAM = 3
"""Explanations that are extended at each level: two effects may mask each other."""
REFITS = 12
"""Explanations with one more effect that are fitted at each level, each by its best variant."""
MOST_EFFECTS = 4
"""A minute of flight hardly determines more."""
SEARCHED, BLOCKS = 15_000, 6
"""Rows of the training that a search sees, a minute at 250 Hz, and the blocks they are cut in."""
BRIEF = 3
"""Part of those rows on which many starts and structures are tried before the best go on: one of
three."""
BRIEF_BLOCK_S = 3.0
"""Least length of the blocks they are cut in, for each begins with a lead."""
FEW_STARTS = 2
"""Starts of a candidate that are scored on all rows."""
HOPELESS = -8.0
"""Linear score relative to the best, nats, below which a candidate is not fitted: about where it
would improve nothing even without its prior."""
PER_NONLINEAR = 2.0
"""Cost in that score of a parameter chosen from a grid, nats, as Laplace's approximation gives it
to a parameter that the data know ten times better than its prior; the fit's evidence decides."""

# what the validation segments must show

LEVEL = 0.05
"""The contract's level: an effect is claimed with p at most this."""
LEAST_BLOCKS = 4
"""Windows below which a test says nothing."""
DIFFERS = 1.1
"""Factor by which two errors must differ to count: from what noise causes (contract), and from
the prediction without commands."""
FLIPS = 200
"""Random draws of the innovations' signs, all of which an error must exceed: a level of 0.5 %."""

# how the reference is explained

EXPLAINS = 90.0
"""Percent of the base's miss, as the reference sees it, that the answer's rung explains."""
ENOUGH = 99.0
"""Percent below which the whole reference stands as the last, finest rung."""
MOST_RUNGS = 8
NAMED_FIRST = 0.9
"""Share of the best step that a named law has to take to stand before a curve."""
NEGLIGIBLE = 0.01
"""Share of the base's miss, and of the motion, below which nothing is called a cause."""
PRIOR_SIGMAS = 5.0
"""Standard deviations of a law's prior within which its parameters lie. It weighs little in a
projection: a gain that falls with time would be a sagging battery's, by the voltage to the power
of 20."""
PROJECTED = 2
"""Named laws, and effects of the reference, that are projected at each rung."""
LEAST_OF_BEST = 0.4
"""Share of the missing torque, relative to the best candidate's, from which a law is projected."""
RESAMPLES = 200
"""Resampled flights."""
BLOCK_S = 2.0
"""Length of their blocks, longer than most gusts."""
MOST_STRUCTURES = 40
"""Structures of the search that a resampled flight chooses from."""
LEAST_SHARE = 0.02
"""Share of the resampled flights below which another leading structure is not looked at."""
AGAIN = 0.5
"""Share of the resampled flights in which an effect must come again."""
