"""The objective of a PID design and its constraints: tracking, disturbance, noise, margins.

Figures of gains relative to the flown ones, and the box of the search. pid.py has the search,
assess.py the figures.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import CONTRACT_NAMES, CascadeGains, Margins
from quad_sysid.loop.plant import LoopPlant
from quad_tuning.assess import disturbance, noise_gain, reference_square, tracking
from quad_tuning.bounds import BOUNDS, DESIGNED, check_bounds
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError

REACH = 16.0
"""Largest factor between flown and new gain; the bounds apply too."""
POWERS = {'rate_ki': 3.0, 'rate_kd': 2.0}
"""Power of the cube's coordinate for gains that may be 0; the others are logarithmic."""
DISTURBANCE_SHARE, NOISE_SHARE = 0.05, 0.005
"""Shares of the objective beside the tracking, each figure relative to the flown gains."""
NOMINAL = 4
"""Number of nominal requirements: overshoot, noise, crossover, disturbance."""


@dataclass(frozen=True)
class Requirements:
    """Requirements on every loop of the ensemble, or on the nominal one."""

    phase_margin_deg: float = 45.0
    gain_margin_db: float = 8.0
    peak_sensitivity: float = 1.8
    overshoot_pct: float = 15.0
    """Nominal, of the square wave."""
    noise_factor: float = 3.0
    """Noise at the motors relative to the flown gains; always allowed up to `motor_noise`."""
    motor_noise: float = 0.01
    """Harmless RMS noise at the motors, normalised command."""
    disturbance_factor: float = 1.0
    """RMS angle under a torque step, relative to the flown gains."""
    highest_crossover_rad_s: float = float('inf')
    """Nominal."""


@dataclass(frozen=True)
class Problem:
    """Everything that is constant during a search."""

    plant: LoopPlant
    active: CascadeGains
    ensemble: Ensemble
    nominal: Ensemble
    needs: Requirements
    reference: FloatArray
    scale: tuple[float, float, float]
    low: FloatArray
    high: FloatArray

    def gains(self, x: FloatArray) -> CascadeGains:
        """Gains at a point (5,) of the unit cube."""
        values = {}
        for field, share, low, high in zip(DESIGNED, np.clip(x, 0.0, 1.0), self.low, self.high,
                                           strict=True):
            power = POWERS.get(field)
            values[field] = float(low * (high / low) ** share if power is None
                                  else low + share**power * (high - low))
        return replace(self.active, **values)

    def point(self, gains: CascadeGains) -> FloatArray:
        """The point (5,) of the unit cube for `gains`, clipped to it."""
        values = np.array([getattr(gains, field) for field in DESIGNED])
        shares = []
        for field, value, low, high in zip(DESIGNED, values, self.low, self.high, strict=True):
            power = POWERS.get(field)
            if power is None:
                width = np.log(high / low)
                shares.append(np.log(max(value, 1e-12) / low) / width if width > 0.0 else 0.0)
            else:
                shares.append(max((value - low) / (high - low), 0.0) ** (1.0 / power))
        return np.asarray(np.clip(np.array(shares), 0.0, 1.0))

    def value(self, gains: CascadeGains) -> tuple[float, FloatArray]:
        """The objective, and the nominal constraints (4,), satisfied where >= 0."""
        rms, beyond = tracking(self.plant, gains, self.reference)
        push = disturbance(self.plant, gains) / self.scale[1]
        noise = noise_gain(gains, self.nominal) / self.scale[2]
        value = rms / self.scale[0] + DISTURBANCE_SHARE * push + NOISE_SHARE * noise
        if not np.isfinite(value):
            return 1e3, np.full(NOMINAL, -1.0)
        highest = self.needs.highest_crossover_rad_s
        crossover = float('nan')
        if np.isfinite(highest):
            crossover = float(self.nominal.margins(gains).crossover_rad_s[0])
        kept = [(self.needs.overshoot_pct - beyond) / 100.0, 1.0 - noise / self.needs.noise_factor,
                1.0 if np.isnan(crossover) else 1.0 - crossover / highest,
                1.0 - push / self.needs.disturbance_factor]
        return float(value), np.clip(kept, -1.0, 1.0)

    def room(self, loops: Ensemble, gains: CascadeGains) -> FloatArray:
        """(3 p,) relative margin of every loop to each requirement, satisfied where >= 0.

        It has a slope everywhere up to instability, so that a search can start anywhere.
        """
        m, needs = loops.margins(gains), self.needs
        return np.concatenate(
            [np.clip(m.phase_margin_deg / needs.phase_margin_deg - 1.0, -1.0, 1.0),
             np.clip(m.gain_margin_db / needs.gain_margin_db - 1.0, -1.0, 1.0),
             np.clip(needs.peak_sensitivity / m.peak_sensitivity - 1.0, -1.0, 1.0)]
        )

    def holds(self, gains: CascadeGains) -> bool:
        """Whether every loop of the ensemble keeps its margins and is stable."""
        kept = meets(self.ensemble.margins(gains), self.needs).all()
        return bool(kept and not self.ensemble.unstable(gains).any())


def meets(margins: Margins, needs: Requirements) -> npt.NDArray[np.bool_]:
    """(p,) True where a loop keeps phase margin, gain margin and peak sensitivity."""
    return np.asarray(
        (margins.phase_margin_deg >= needs.phase_margin_deg)
        & (margins.gain_margin_db >= needs.gain_margin_db)
        & (margins.peak_sensitivity <= needs.peak_sensitivity)
    )


def pose(plant: LoopPlant, active: CascadeGains, ensemble: Ensemble, needs: Requirements,
         fixed: Collection[str] = ()) -> Problem:
    """The problem of one axis; raises DesignRefusedError where the flown loop diverges.

    `fixed` are fields of CascadeGains that do not change.
    """
    check_bounds({f'flown.{CONTRACT_NAMES[f]}': getattr(active, f) for f in DESIGNED})
    low, high = [], []
    for field in DESIGNED:
        bound, value = BOUNDS[CONTRACT_NAMES[field]], getattr(active, field)
        if field in fixed:
            low.append(value)
            high.append(value)
            continue
        free = field in POWERS
        low.append(bound.lower if free else max(bound.lower, value / REACH))
        high.append(bound.upper if free else min(bound.upper, value * REACH))
    reference = reference_square(plant.dt)
    nominal = ensemble.subset(np.flatnonzero(ensemble.nominal)[:1])
    scale = (tracking(plant, active, reference)[0], disturbance(plant, active),
             noise_gain(active, nominal))
    if not np.isfinite(scale).all():
        raise DesignRefusedError('the simulated loop diverges with these gains; identify again')
    return Problem(plant, active, ensemble, nominal, needs, reference, scale,
                   np.array(low), np.array(high))
