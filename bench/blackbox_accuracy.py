"""Monte-Carlo accuracy on the reference record: RMS error against the Cramer-Rao bound.

    python bench/blackbox_accuracy.py [RUNS]

Ends with one JSON object on its last line.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from quad_sysid.blackbox import armax, arx, bj, clriv, compare, oe
from quad_sysid.blackbox.prediction_error import evaluate

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test'))
from known_plants import Study, polynomial_model, reference_study

CHI2_20_99 = 37.566


def bound(runs: int) -> np.ndarray:
    """Cramer-Rao standard deviations: from the mean information at the truth over some records."""
    study = reference_study()
    information = np.mean(
        [
            evaluate(study.truth, study.record(np.random.default_rng(50_000 + i))).hessian
            for i in range(runs)
        ],
        axis=0,
    ) / study.truth.noise_variance
    return np.sqrt(np.diag(np.linalg.inv(information)))


def monte_carlo(runs: int) -> dict[str, object]:
    """BJ and CL-RIV: error over bound, coverage of 95 % intervals, NEES."""
    study, crb = reference_study(), bound(20)
    result: dict[str, object] = {'runs': runs, 'names': list(study.truth.parameter_names)}
    for name, fit in (('BJ', bj), ('CLRIV', clriv)):
        errors, inside, nees, converged = [], [], [], 0
        for seed in range(runs):
            z = study.record(np.random.default_rng(10_000 + seed))
            model = fit(z, 2, 2, 2, 2, 3)
            error = model.parameters - study.truth.parameters
            errors.append(error)
            inside.append(np.abs(error) < 1.96 * model.std)
            nees.append(float(error @ np.linalg.solve(model.covariance, error)))
            converged += model.converged
        ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / crb
        result[name] = {
            'rms_over_bound': [round(float(x), 3) for x in ratio],
            'coverage_95': round(float(np.mean(inside)), 4),
            'nees': round(float(np.mean(nees)), 3),
            'converged': converged,
        }
        print(name, result[name])
    return result


def per_seed(seeds: int) -> dict[str, object]:
    """Points of free-run fit below the true model's, on another record, worst and mean."""
    study = reference_study()
    below = []
    for seed in range(seeds):
        z = study.record(np.random.default_rng(seed))
        v = study.record(np.random.default_rng(1000 + seed))
        models = [study.truth, bj(z, 2, 2, 2, 2, 3), oe(z, 2, 2, 3), armax(z, 3, 3, 3, 1)]
        fits = compare(v, *models)
        below.append([fits[0] - fit for fit in fits[1:]])
    names = ('BJ', 'OE', 'ARMAX')
    result = {
        name: {'worst': round(float(np.max(column)), 4), 'mean': round(float(np.mean(column)), 4)}
        for name, column in zip(names, np.transpose(below), strict=True)
    }
    print('points below the truth:', result)
    return result


def table3_study() -> Study:
    """Build the paper's ARX 10 10 5 (Table 3) with the sign of B turned, in its own loop."""
    a = [1, -0.579, -0.115, -0.571, -0.010, 0.0728, 0.035, -0.012, 0.075, 0.052, 0.055]
    b = [0.005, 0.004, 0.004, 0.003, 0.002, 0.002, 0.0017, 0.0008, 0.0007, 0.0007]
    return Study(polynomial_model([0.0] * 5 + b, A=a, dt=0.004, noise_variance=0.25))


def table3(seeds: int) -> dict[str, object]:
    """The paper's ARX 10 10 5 in its loop: squared distance of its 20 coefficients."""
    study = table3_study()
    distances = []
    for seed in range(seeds):
        model = arx(study.record(np.random.default_rng(seed)), 10, 10, 5)
        error = model.parameters - study.truth.parameters
        distances.append(float(error @ np.linalg.solve(model.covariance, error)))
    result = {
        'seeds': seeds, 'mean': round(float(np.mean(distances)), 2),
        'above_99': int(np.sum(np.array(distances) > CHI2_20_99)),
    }
    print('Table 3:', result)
    return result


if __name__ == '__main__':
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    outcome = {'table3': table3(50), 'per_seed': per_seed(20), 'monte_carlo': monte_carlo(count)}
    print(json.dumps(outcome))
