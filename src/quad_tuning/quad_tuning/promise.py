"""What a design promises to the watch in flight: how the rates change under the same disturbances.

Figures for the bridge (its gains/watch.py): ratios of after to before, from the loops of the
nominal plant. No verdict here.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import CascadeGains, open_loop, reference_response
from quad_sysid.loop.plant import ComplexArray
from quad_tuning.ensemble import Ensemble

GUST_RAD_S = 3.0
"""Corner of the disturbing torque: below it gusts are as strong as they get."""
BANDS_RAD_S = (4.0, 8.0, 16.0, 32.0, 64.0)
"""Centres of the octaves that the watch listens to."""


def promise(
    loops: Ensemble, before: CascadeGains, after: CascadeGains, lag_s: float
) -> dict[str, float]:
    """`rate_rms_ratio`, `oscillation_ratio` (the worst octave) and `peak` of the new loop.

    `lag_s` is the motors' lag, which the torque of a gust does not pass.
    `peak` is the largest gain from the angle's reference to the angle, over all drawn plants.
    """
    old, new = (
        open_loop(gains, loops.response, loops.omega, loops.cycle.dt) for gains in (before, after)
    )
    peak = np.abs(reference_response(after, loops.response, loops.omega, loops.cycle.dt)).max()
    return {**ratios(loops, old, new, lag_s), 'peak': float(peak)}


def ratios(
    loops: Ensemble, before: ComplexArray, after: ComplexArray, lag_s: float
) -> dict[str, float]:
    """`rate_rms_ratio` and `oscillation_ratio` from two sets of loop gains (p, f)."""
    old, new = _power(loops, before, lag_s), _power(loops, after, lag_s)
    octaves = [
        (loops.omega > centre / np.sqrt(2.0)) & (loops.omega < centre * np.sqrt(2.0))
        for centre in BANDS_RAD_S
    ]
    every = [np.sqrt(new[band].sum() / old[band].sum()) for band in octaves if band.any()]
    return {
        'rate_rms_ratio': float(np.sqrt(new.sum() / old.sum())),
        'oscillation_ratio': float(max(every)),
    }


def _power(loops: Ensemble, loop: ComplexArray, lag_s: float) -> FloatArray:
    """(f,) power of the rate per point of the logarithmic grid, under gusts; mean of nominals."""
    gust = loops.omega / (1.0 + (loops.omega / GUST_RAD_S) ** 2)
    gust *= 1.0 + (loops.omega * lag_s) ** 2
    power = gust * np.abs(loops.response[0] / (1.0 + loop)) ** 2
    return np.asarray(power[loops.nominal].mean(axis=0))
