"""Random plants in closed loop: does every fit reach the optimum that the truth leads to?

    python bench/blackbox_random_plants.py [COUNT]

A failure is an N ln V more than 0.5 above that of the fit from the truth.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from quad_sysid.blackbox import Model, armax, bj, oe, polynomial_model

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test'))
from known_plants import Cascade, Study


def random_roots(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """`count` roots of radius low..high, real or in pairs."""
    roots: list[complex] = []
    while len(roots) < count:
        radius = rng.uniform(low, high)
        if count - len(roots) > 1 and rng.random() < 0.4:
            pole = radius * np.exp(1j * rng.uniform(0.02, 1.5))
            roots += [pole, pole.conjugate()]
        else:
            roots.append(complex(radius))
    return np.real(np.poly(roots)) if roots else np.ones(1)


def random_study(rng: np.random.Generator, structure: str) -> Study:
    """A plant of order 1..4 with delay and coloured noise, in a stable cascade."""
    nf, nk = int(rng.integers(1, 5)), int(rng.integers(1, 6))
    nb = int(rng.integers(1, nf + 1))
    den = random_roots(rng, nf, 0.5, 0.995)
    b = np.convolve([1.0], random_roots(rng, nb - 1, 0.1, 1.3))
    gain = np.sum(b) / np.sum(den)
    b = b / (abs(gain) + np.sum(np.abs(b))) * np.sign(gain or 1.0)
    noise = {'C': random_roots(rng, int(rng.integers(0, 3)), 0.1, 0.8)}
    if structure == 'BJ':
        noise |= {'D': random_roots(rng, int(rng.integers(0, 3)), 0.1, 0.95), 'F': den}
    elif structure == 'OE':
        noise = {'F': den}
    else:
        noise |= {'A': den}
    B = np.concatenate((np.zeros(nk), b))
    kp = stable_gain(den, B)
    truth = polynomial_model(B, dt=0.004, noise_variance=1e-12, **noise)
    y_rms = np.std(Study(truth, Cascade(3.0, kp, 0.0, 0.0), samples=3000).record(rng).y)
    truth = polynomial_model(
        B, dt=0.004, noise_variance=float(rng.uniform(0.02, 0.3) * y_rms) ** 2, **noise
    )
    return Study(truth, Cascade(3.0, kp, 0.0, 0.0), samples=6000)


def stable_gain(den: np.ndarray, B: np.ndarray) -> float:
    """A third of the highest tried P gain that keeps the cascade stable."""
    for kp in np.geomspace(100.0, 1e-4, 60):
        loop = np.polyadd(
            np.pad(np.convolve(den, [1.0, -1.0]), (0, max(0, B.size - den.size))),
            np.pad(kp * np.convolve(B, [1.012, -1.0]), (0, max(0, den.size - B.size))),
        )
        if np.max(np.abs(np.roots(loop))) < 0.999:
            return float(kp / 3.0)
    return 1e-5


def fit(structure: str, study: Study, rng: np.random.Generator) -> tuple[Model, Model]:
    """The fit from its own start values, and from the truth."""
    z, truth = study.record(rng), study.truth
    na, nc, nd, nf = (poly.size - 1 for poly in (truth.A, truth.C, truth.D, truth.F))
    nb, nk = truth.B.size - truth.nk, truth.nk
    if structure == 'BJ':
        return bj(z, nb, nc, nd, nf, nk), bj(z, nb, nc, nd, nf, nk, start=truth)
    if structure == 'OE':
        return oe(z, nb, nf, nk), oe(z, nb, nf, nk, start=truth)
    return armax(z, na, nb, nc, nk), armax(z, na, nb, nc, nk, start=truth)


def main(count: int) -> None:
    """Run `count` plants per structure."""
    result: dict[str, object] = {'plants': count}
    for structure in ('ARMAX', 'OE', 'BJ'):
        failures, unconverged, seconds = [], 0, 0.0
        for seed in range(count):
            rng = np.random.default_rng([seed, *structure.encode()])
            study = random_study(rng, structure)
            begin = time.perf_counter()
            own, from_truth = fit(structure, study, rng)
            seconds += time.perf_counter() - begin
            unconverged += not own.converged
            excess = own.samples * np.log(own.loss / from_truth.loss)
            if excess > 0.5:
                failures.append((seed, round(float(excess), 2)))
        print(f'{structure:6s} failures {len(failures):4d} of {count}, '
              f'not converged {unconverged}, {1e3 * seconds / count:.0f} ms per pair')
        if failures:
            print('       seed, excess:', failures[:20])
        result[structure] = {'failures': len(failures), 'unconverged': unconverged}
    print(json.dumps(result))


if __name__ == '__main__':
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
