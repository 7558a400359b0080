"""Are the probabilities of structures what they say? Simulation-based calibration.

    python bench/evidence.py [--flights 200] [--seed 0]

The structure of each flight is drawn with equal chances (nothing, dry friction, quadratic drag, a
dead zone), its strength from the prior that the analysis has of it; the axis is simulated here.
All four structures are fitted, and their evidence gives each a probability. Where these hold, a
structure said to have probability p is the true one in a share p of the cases. Told are the
reliability curve, the Brier score beside what it would be if the probabilities hold, and how often
an effect is the likeliest where nothing was missing. Ends with one JSON object on its last line.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math

import numpy as np
from numba import njit
from scipy.signal import lfilter

from quad_sysid.contract import FloatArray
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.fit import Fit, Problem, fit, start_of
from quad_sysid.model.data import AxisData, axis_alone
from quad_sysid.model.effect import Part
from quad_sysid.model.structure import Structure, coordinates

DT, SECONDS, SUBSTEPS = 0.01, 25.0, 10
NAMES = ('coulomb_friction', 'quadratic_drag', 'dead_zone')
EDGES = (0.0, 0.02, 0.1, 0.3, 0.7, 0.9, 0.98, 1.0)
TRANSITION = 0.005
"""Of the friction, rad/s: the centre of its prior."""


@njit(cache=True)
def _fly(command, torque, gyro, friction, drag, dead):
    """(n,) measured rates of an axis with gain 450, lag 40 ms, delay 10 ms, damping 0.5."""
    h = DT / SUBSTEPS
    fade = math.exp(-h / 0.04)
    r = drive = 0.0
    rate = np.zeros(command.size)
    for k in range(command.size):
        rate[k] = r + gyro[k]
        u = command[max(k - 1, 0)]
        u = math.copysign(max(abs(u) - dead, 0.0), u)
        for i in range(SUBSTEPS):
            before = drive
            drive = 450.0 * u + (drive - 450.0 * u) * fade
            slope = before - 0.5 * r - friction * math.tanh(r / TRANSITION) - drag * r * abs(r)
            m = r + 0.5 * h * (slope + torque[k * SUBSTEPS + i])
            slope = 0.5 * (before + drive) - 0.5 * m
            slope -= friction * math.tanh(m / TRANSITION) + drag * m * abs(m)
            r += h * (slope + torque[k * SUBSTEPS + i])
    return rate


def flight(rng: np.random.Generator, friction: float, drag: float, dead: float) -> AxisData:
    """A command of random levels under gusts."""
    n = round(SECONDS / DT)
    command = np.repeat(rng.uniform(-0.01, 0.01, n // 10), 10)
    pole = math.exp(-DT / SUBSTEPS / 0.3)
    push = 0.3 * math.sqrt(1.0 - pole**2) * rng.standard_normal(n * SUBSTEPS)
    push[0] = 0.0
    torque = lfilter([1.0], [1.0, -pole], push)
    rate = _fly(command, torque, 0.005 * rng.standard_normal(n), friction, drag, dead)
    return axis_alone(command, rate, DT, ((0, n),))


def fits(data: AxisData) -> list[Fit]:
    """Fits of the base alone, and of the base with each of NAMES."""
    problem = Problem(data, data.train)
    base = fit(problem, Structure(), start_of(problem))
    problem.measure(base)
    out = [base]
    for name in NAMES:
        effect = next(e for e in EFFECTS if e.name == name)
        part = Part(effect, {})
        structure, best = Structure((part,)), None
        for start in effect.starts(data, {}):
            own = coordinates(part.effect.parameters, start)
            theta = np.r_[base.theta[:5], own, base.theta[5:]]
            try:
                one = fit(problem, structure, theta, rate=base.rate)
            except (FloatingPointError, np.linalg.LinAlgError):
                continue
            if best is None or one.log_posterior > best.log_posterior:
                best = one
        out.append(best or base)
    return out


def spreads(rng: np.random.Generator) -> FloatArray:
    """(2,) of the priors of friction and drag on a flight of the plain axis."""
    data = flight(rng, 0.0, 0.0, 0.0)
    problem = Problem(data, data.train)
    problem.measure(fit(problem, Structure(), start_of(problem)))
    parts = [Part(next(e for e in EFFECTS if e.name == name)) for name in NAMES[:2]]
    return np.array([problem.sizes_of(part)[0] for part in parts])


def main() -> None:
    """Draw, fit and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--flights', type=int, default=200)
    parser.add_argument('--seed', type=int, default=0)
    asked = parser.parse_args()
    usual = spreads(np.random.default_rng(asked.seed))
    said, true = [], []
    for number in range(asked.flights):
        rng = np.random.default_rng(np.random.SeedSequence([asked.seed, number]))
        which = int(rng.integers(4))
        strengths = np.zeros(3)
        if which in (1, 2):
            strengths[which - 1] = abs(rng.standard_normal()) * usual[which - 1]
        elif which:
            strengths[2] = min(math.exp(math.log(0.003) + 2.0 * rng.standard_normal()), 0.009)
        evidence = np.array([one.evidence for one in fits(flight(rng, *strengths))])
        p = np.exp(evidence - evidence.max())
        said.append(p / p.sum())
        true.append(np.arange(4) == which)
    p, truth = np.array(said), np.array(true)
    curve = []
    for low, high in itertools.pairwise(EDGES):
        inside = (p >= low) & ((p < high) | (high == 1.0))
        if inside.any():
            curve.append((round(float(p[inside].mean()), 4), round(float(truth[inside].mean()), 4),
                          int(inside.sum())))
            print(f'said {curve[-1][0]:.3f}  true {curve[-1][1]:.3f}  of {curve[-1][2]}')
    nothing = p[truth[:, 0]]
    print(json.dumps({
        'flights': asked.flights, 'curve': curve,
        'brier': round(float(np.mean((p - truth) ** 2)), 4),
        'brier_if_true': round(float(np.mean(p * (1.0 - p))), 4),
        'right': round(float(np.mean(truth[np.arange(len(p)), p.argmax(axis=1)])), 4),
        'nothing': len(nothing), 'effect_likeliest': int((nothing.argmax(axis=1) > 0).sum()),
    }))


if __name__ == '__main__':
    main()
