"""Whether an axis was flown with feedback from its rate to its command: shown, excluded, or not.

That no test sees feedback does not exclude it: where the controller is fast or the command swings
far, the rate's noise drowns in the command. So "none" needs a proof of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.blackbox import Model, residual_test
from quad_sysid.blackbox.innovations import one_step_errors
from quad_sysid.blackbox.regression import lagged
from quad_sysid.contract import FloatArray
from quad_sysid.errors import QuadSysidError
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.pipeline.approaches import KNOWN_CONTROLLER_PCT, controller, reproduced
from quad_sysid.record import IOData, Record

FEEDBACK_LEVEL = 0.01
FEW_LEVELS = 8
"""A command of no more values than these answers to no noisy rate (PRBS, square, 3-2-1-1)."""
SAME = 1e-4
"""Part of the command's spread within which two values are one."""
PAST = 30
"""Samples of the command's own past that its next value is predicted from."""
CYCLES = 3
"""Cycles within which a controller answers to the rate."""
NEGLIGIBLE = 0.2
"""Loop gain below which feedback neither biases the direct approach nor shapes the flight."""
SURE = 3.0
"""Standard errors up to which feedback that was not seen may be there."""


def feedback(
    z: IOData, model: Model, gains: CascadeGains | None, *, behind_attitude: bool, through: bool
) -> bool | None:
    """Whether the command answers to the rate; None where neither can be shown.

    True where the residual of `model` foresees the command, with nothing but the past of the
    command taken out (or the plant is not causal), or where the command is that of the known
    controller on the reference z.r (`behind_attitude`: the attitude's) and the rate. False where
    the command takes a few values only, or the loop gain that could have been missed is below
    NEGLIGIBLE; never where the excitation came `through` C1 or C2, which are feedback.
    """
    try:
        test = residual_test(model, replace(z, r=None))
        if test.p_causal < FEEDBACK_LEVEL:
            return True
        if (gains is not None and behind_attitude
                and reproduced(z, controller(gains, z.dt)) >= KNOWN_CONTROLLER_PCT):
            return True
        if through:
            return None
        excluded = _few_levels(z) or largest_loop_gain(z, model) < NEGLIGIBLE
    except QuadSysidError:
        return None
    return False if excluded else None


def through_controller(records: Sequence[Record], axis: str) -> bool:
    """Whether training was excited in front of C1 or C2, so that a controller passed it on."""
    return any(
        s.injection in ('attitude', 'rate') and s.signal not in ('none', 'unknown')
        for r in records for s in r.segments if s.role == 'train' and s.axis == axis
    )


def _few_levels(z: IOData) -> bool:
    u = np.concatenate([z.u[a:b] for a, b in z.segments])
    spread = float(u.std())
    return spread > 0.0 and np.unique(np.round(u / (SAME * spread))).size <= FEW_LEVELS


def largest_loop_gain(z: IOData, model: Model) -> float:
    """Loop gain that the data do not exclude: feedback gain times rate over command.

    The feedback gain is that from the one-step errors (of the last CYCLES) to the command beyond
    what the command's past foretells, SURE standard errors added; inf where it has no estimate.
    """
    blocks: list[FloatArray] = []
    for part in one_step_errors(model, z):
        e = np.zeros(z.u.size)
        e[part.start : part.start + part.errors.size] = part.errors
        start, stop = part.start + max(PAST, CYCLES), part.start + part.errors.size
        if start < stop:
            blocks.append(np.column_stack((
                lagged(e, range(CYCLES), start, stop),
                lagged(z.u, range(1, PAST + 1), start, stop),
                np.ones(stop - start), z.u[start:stop],
            )))
    rows = np.vstack(blocks) if blocks else np.zeros((0, CYCLES + PAST + 2))
    if rows.shape[0] <= 2 * rows.shape[1]:
        return float('inf')
    past, targets = rows[:, CYCLES:-1], np.column_stack((rows[:, :CYCLES], rows[:, -1]))
    left = targets - past @ np.linalg.lstsq(past, targets, rcond=1e-12)[0]
    gram = left[:, :CYCLES].T @ left[:, :CYCLES]
    if np.linalg.cond(gram) > 1e12:
        return float('inf')
    found = np.linalg.solve(gram, left[:, :CYCLES].T @ left[:, -1])
    rest = left[:, -1] - left[:, :CYCLES] @ found
    power = float(rest @ rest) / (rows.shape[0] - rows.shape[1] + 1)
    spread = np.sqrt(power * np.diag(np.linalg.inv(gram)))
    gain = float(np.max(np.abs(found) + SURE * spread))
    u = np.concatenate([z.u[a:b] for a, b in z.segments])
    y = np.concatenate([z.y[a:b] for a, b in z.segments])
    return gain * float(y.std() / u.std()) if u.std() > 0.0 else float('inf')
