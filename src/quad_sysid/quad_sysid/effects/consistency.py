"""Whether the base's held-out error is what its training error leads one to expect.

A model that lacks nothing errs as much on unseen segments as on its own, evenly over time. One
that bends its parameters around a missing effect does not, even where no effect is found.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.covariance import block_numbers
from quad_sysid.greybox.data import Windows

GROWTH = 1.3
"""Held-out over training error beyond which a base does not hold (nothing missing: up to 1.2)."""
LEVEL = 0.01
"""Of Welch's test over blocks that the held-out error is no larger."""
CLEAR_GROWTH, CLEAR_LEVEL = 1.5, 0.05
"""The same where it is larger than nothing missing ever makes it."""
WORST = 0.2
"""Share of the blocks that may hold an event."""
STRUCK = 4.0
"""A block is named whose squared error is this many times that of an ordinary one."""
UNEVEN = 1.4
"""Error of all blocks over that without the worst ones (nothing missing: up to 1.2)."""


SPREAD = 2.5
"""Error of all blocks over that of the middle one (nothing missing: up to 1.3)."""


def inconsistency(
    training: FloatArray, training_windows: Windows, held_out: FloatArray,
    held_out_windows: Windows, dt: float,
) -> str:
    """In words what does not agree, or nothing. Errors (windows,) are mean squares."""
    seen, _ = _blocks(training, training_windows, dt)
    unseen, starts = _blocks(held_out, held_out_windows, dt)
    if min(seen.size, unseen.size) < 5:
        return ''
    order = np.argsort(unseen)
    worst = order[-max(1, round(WORST * unseen.size)) :]
    rest = np.delete(unseen, worst)
    uneven = float(np.sqrt(unseen.mean() / max(rest.mean(), 1e-300)))
    spread = float(np.sqrt(unseen.mean() / max(float(np.median(unseen)), 1e-300)))
    if uneven > UNEVEN or spread > SPREAD:
        struck = [i for i in sorted(worst[-3:]) if unseen[i] > STRUCK * np.median(rest)]
        times = ', '.join(f'{starts[i] * dt:.0f}' for i in struck or worst[-1:])
        return (
            f'the held-out error is {max(uneven, spread):.1f} times as large with a few moments '
            f'(around {times} s) as without them: something happens there that the model does '
            'not know'
        )
    growth = float(np.sqrt(unseen.mean() / max(seen.mean(), 1e-300)))
    larger = stats.ttest_ind(
        np.log(unseen + 1e-300), np.log(seen + 1e-300), equal_var=False, alternative='greater'
    )
    level = CLEAR_LEVEL if growth > CLEAR_GROWTH else LEVEL
    if growth > GROWTH and float(larger.pvalue) < level:
        return (
            f'the error on the held-out segments is {growth:.1f} times that on the training '
            'segments: the base has bent around something that acts differently there'
        )
    return ''


def _blocks(squared: FloatArray, windows: Windows, dt: float) -> tuple[FloatArray, np.ndarray]:
    """(blocks,) mean squared errors, and the first sample of each block."""
    number = block_numbers(windows, dt)
    count = int(number.max(initial=-1)) + 1
    size = np.bincount(number, minlength=count)
    starts = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(starts, number, windows.starts)
    return np.bincount(number, squared, minlength=count) / size, starts
