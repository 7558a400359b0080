"""The grey box of one axis against the Cramer-Rao bound, in open and in closed loop.

    python bench/accuracy.py [--flights 25] [--seed 0]

An axis with gain, motor lag, delay, damping and bias is simulated here with steps of 0.5 ms, not
by the model's own recursion, under a torque disturbance that is up to five times as large as what
the excitation does at low frequency. Each flight is fitted by the product's search for the base.
Told are bias over its own standard error, RMS error over the bound (information at the truth, the
noise unknown as well), and how often 1.96 standard errors hold the truth. Ends with one JSON
object on its last line.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.signal import chirp as swept
from scipy.signal import lfilter
from scipy.stats import norm

from quad_sysid.contract import FloatArray
from quad_sysid.discover.base import best_base
from quad_sysid.estimate.fit import Problem, fit
from quad_sysid.estimate.stored import readings
from quad_sysid.model.data import AxisData, axis_alone
from quad_sysid.model.structure import NOISE, Structure

DT = 0.004
SUBSTEPS = 8
SECONDS = 40.0
SETTLE_S = 2.0
TRUTH = {'gain': 450.0, 'lag': 0.0426, 'delay': 0.009, 'damping': 0.8, 'bias': 0.3}
GYRO = 0.01
"""White noise of the gyro, rad/s."""
CORRELATION_S = 0.5
"""Of the torque disturbance."""
SIGNALS = ('prbs', 'chirp', 'doublets', 'steps', 'flying')
STRENGTHS = (0.2, 1.0, 5.0)
"""Torque disturbance over the excitation's effect below 1 Hz."""
AMPLITUDE = {'open': 0.02, 'closed': 0.5}
"""Of the excitation: of the command, or of the rate reference in rad/s."""


@dataclass(frozen=True)
class Case:
    """One kind of flight."""

    signal: str
    loop: str
    strength: float

    def __str__(self) -> str:
        """Signal, loop and strength."""
        return f'{self.signal:9} {self.loop:6} x{self.strength:g}'


CASES = tuple(
    Case(signal, loop, strength)
    for loop in ('open', 'closed') for signal in SIGNALS for strength in STRENGTHS
    if not (loop == 'open' and (signal == 'flying' or strength > 1.0))
)
"""In open loop nobody flies, and a strong disturbance turns the axis over."""


def excitation(signal: str, n: int, rng: np.random.Generator) -> FloatArray:
    """(n,) of size 1: what is added to the command or to the rate reference."""
    t = np.arange(n) * DT
    if signal == 'prbs':
        return np.repeat(rng.choice([-1.0, 1.0], n // 20 + 1), 20)[:n]
    if signal == 'chirp':
        return np.asarray(swept(t % 20.0, 0.2, 20.0, 8.0), dtype=float)
    if signal == 'doublets':
        width, period = rng.uniform(0.1, 0.4), 1.5
        phase = t % period
        return np.where(phase < width, 1.0, np.where(phase < 2.0 * width, -1.0, 0.0))
    if signal == 'steps':
        return np.repeat(rng.uniform(-1.0, 1.0, n // 75 + 1), 75)[:n]
    pole = math.exp(-2.0 * math.pi * 1.0 * DT)  # a stick that moves below 1 Hz
    slow = lfilter([1.0 - pole], [1.0, -pole], rng.standard_normal(n))
    slow = lfilter([1.0 - pole], [1.0, -pole], slow)
    return np.asarray(slow / np.std(slow))


@njit(cache=True)
def _fly(added, closed, torque, gyro, gain, lag, delay, damping, bias, kp, ki, held_back):
    """Commands (n,) and measured rates (n,): the loop at DT, physics SUBSTEPS times a cycle."""
    n = added.size
    h = DT / SUBSTEPS
    fade, ease = math.exp(-h / lag), math.exp(-damping * h)
    pushed = (1.0 - ease) / damping if damping > 0.0 else h
    late = round(delay / h)
    command, rate = np.zeros(n), np.zeros(n)
    fine = np.zeros(n * SUBSTEPS + late + 1)
    r = drive = total = 0.0
    for k in range(n):
        rate[k] = r + gyro[k]
        u = added[k]
        if closed:
            error = added[k] - rate[k]
            total += ki * error * DT
            u = kp * error + total
        command[k] = min(max(u, -held_back), held_back)
        for i in range(SUBSTEPS):
            m = k * SUBSTEPS + i
            fine[m + late] = command[k]
            before = drive
            drive = gain * fine[m] + (drive - gain * fine[m]) * fade
            r = r * ease + pushed * (0.5 * (before + drive) + bias + torque[m])
    return command, rate


def flight(case: Case, rng: np.random.Generator) -> AxisData:
    """One flight of a case."""
    n = round(SECONDS / DT)
    added = AMPLITUDE[case.loop] * excitation(case.signal, n, rng)
    gyro = GYRO * rng.standard_normal(n)
    h = DT / SUBSTEPS
    pole = math.exp(-h / CORRELATION_S)
    wind = lfilter(
        [math.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(n * SUBSTEPS)
    )
    closed = case.loop == 'closed'
    loop = (closed, TRUTH['gain'], TRUTH['lag'], TRUTH['delay'], TRUTH['damping'], TRUTH['bias'])

    def flown(torque: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        closed, *plant = loop
        return _fly(added, closed, torque, noise, *plant, 0.02, 0.02, 0.5)

    quiet = flown(np.zeros_like(wind), np.zeros(n))[0]
    slow = math.exp(-2.0 * math.pi * DT)
    effect = TRUTH['gain'] * lfilter([1.0 - slow], [1.0, -slow], quiet - quiet.mean())
    command, rate = flown(case.strength * float(np.std(effect)) * wind, gyro)
    return axis_alone(command, rate, DT, ((0, n),))


def study(case: Case, flights: int, seed: int) -> dict[str, object]:
    """Bias, spread over the bound and coverage of the base's parameters."""
    errors, stds, bounds = [], [], []
    truth = np.array(list(TRUTH.values()))
    spans = ((round(SETTLE_S / DT), round(SECONDS / DT)),)
    for number in range(flights):
        seeds = np.random.SeedSequence([seed, CASES.index(case), number])
        problem = Problem(flight(case, np.random.default_rng(seeds)), spans)
        found = best_base(problem)
        told = readings(problem, found)
        errors.append([p.value for p in told.base] - truth)
        stds.append([math.nan if p.std is None else p.std for p in told.base])
        bounds.append(bound(problem, found.theta, truth))
    error, std = np.array(errors), np.array(stds)
    spread = np.sqrt(np.mean(np.array(bounds), axis=0))
    return {
        'case': str(case),
        'bias_z': (error.mean(0) / (error.std(0, ddof=1) / math.sqrt(flights))).round(2).tolist(),
        'rms_over_bound': (np.sqrt(np.mean(error**2, axis=0)) / spread).round(2).tolist(),
        'inside': (np.abs(error) < 1.96 * std).sum(axis=0).tolist(),
        'known': np.isfinite(std).sum(axis=0).tolist(),
        'relative_std': (np.median(std, axis=0) / truth).round(4).tolist(),
    }


def bound(problem: Problem, theta: FloatArray, truth: FloatArray) -> FloatArray:
    """(5,) variances: inverse of the information at the truth, of the noise as it was fitted."""
    at = np.r_[truth, theta[5:]]
    at[1:3] = np.log(at[1:3])
    structure = Structure(lines=(theta.size - 5 - len(NOISE)) // 3)
    held = fit(problem, structure, at, max_steps=0)
    information = held.hessian - held.precision
    variance = np.diag(np.linalg.pinv(information))[:5].copy()
    variance[1:3] *= truth[1:3] ** 2
    return variance


def main() -> None:
    """Run all cases and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--flights', type=int, default=25)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='')
    asked = parser.parse_args()
    rows = []
    print(f'{"":23} parameters: {", ".join(TRUTH)}')
    for case in CASES:
        if asked.only not in str(case):
            continue
        row = study(case, asked.flights, asked.seed)
        rows.append(row)
        print(f'{case}  bias/se {row["bias_z"]}  rms/bound {row["rms_over_bound"]}  inside '
              f'{row["inside"]} of {row["known"]}  std {row["relative_std"]}', flush=True)
    inside = np.sum([row['inside'] for row in rows], axis=0)
    known = np.sum([row['known'] for row in rows], axis=0)
    z = np.array([row['bias_z'] for row in rows])
    print(json.dumps({
        'flights': asked.flights, 'coverage': (inside / known).round(4).tolist(),
        'coverage_all': round(float(inside.sum() / known.sum()), 4),
        'largest_bias_z': float(np.abs(z).max()),
        'expected_largest': round(float(norm.isf(0.5 / z.size)), 2), 'cases': rows,
    }))


if __name__ == '__main__':
    main()
