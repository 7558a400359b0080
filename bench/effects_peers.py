"""Time one likelihood by other libraries' filters, in a Python that has them.

    PYTHON bench/effects_peers.py MODEL.npz

Started by effects_speed.py with the same linear model: `statsmodels` (compiled), `filterpy`
(numpy) and `dynamax` (JAX, compiled), each left out where it is missing. Ends with one JSON
object: us a sample for one value of the likelihood, and the RMS of the innovations; of dynamax
also with the derivatives by all matrices.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import numpy as np

REPEATS = 5
"""As in effects_speed.py: the shortest of so many runs, behind one that loads."""


def shortest(call: Callable[[], object]) -> float:
    """The shortest of several runs, s."""
    call()
    spent = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        call()
        spent.append(time.perf_counter() - began)
    return min(spent)


def statsmodels_filter(model: dict[str, np.ndarray]) -> dict[str, float]:
    """Time per cycle, µs, and RMS error of the compiled filter of statsmodels, with inputs."""
    try:
        from statsmodels.tsa.statespace.kalman_filter import KalmanFilter
    except ImportError:
        return {}
    n, states = model['pushes'].size, model['f'].shape[0]
    peer = KalmanFilter(1, states, initialization='approximate_diffuse')
    peer.bind(np.asfortranarray(model['y'][:, None]))
    peer['design'] = model['c'][None, :]
    peer['transition'] = model['f']
    peer['selection'] = np.eye(states)
    peer['state_cov'] = model['q']
    peer['obs_cov'] = model['r'].reshape(1, 1)
    pushes = np.zeros((states, n))
    pushes[0] = model['pushes']
    peer['state_intercept'] = pushes
    spent = shortest(peer.loglike)
    errors = peer.filter().forecasts_error[0, n // 10 :]
    return {'us': 1e6 * spent / n, 'rms': float(np.sqrt(np.mean(errors**2)))}


def filterpy_filter(model: dict[str, np.ndarray]) -> dict[str, float]:
    """Time per cycle, µs, and RMS error of filterpy's KalmanFilter, two calls per sample."""
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError:
        return {}
    n, states = model['pushes'].size, model['f'].shape[0]
    errors = np.empty(n)

    def filtered() -> float:
        peer = KalmanFilter(states, 1, 1)
        peer.F, peer.H, peer.Q, peer.R = model['f'], model['c'][None, :], model['q'], model['r']
        peer.B, total = np.eye(states)[:, :1], 0.0
        for k in range(n):
            peer.update(model['y'][k])
            errors[k] = peer.y[0, 0]
            total += peer.log_likelihood
            peer.predict(model['pushes'][k])
        return total

    spent = shortest(filtered)
    return {'us': 1e6 * spent / n, 'rms': float(np.sqrt(np.mean(errors[n // 10 :] ** 2)))}


def dynamax_filter(model: dict[str, np.ndarray]) -> dict[str, float]:
    """Time and error of dynamax' lgssm_filter in double precision, alone and with derivatives."""
    try:
        import jax
        import jax.numpy as jnp
        from dynamax.linear_gaussian_ssm.inference import lgssm_filter, make_lgssm_params
    except ImportError:
        return {}
    jax.config.update('jax_enable_x64', True)
    n, states = model['pushes'].size, model['f'].shape[0]
    y = jnp.asarray(model['y'])[:, None]
    pushes = jnp.asarray(np.r_[0.0, model['pushes'][:-1]])[:, None]  # input k leads to state k
    into = np.eye(states)[:, :1]

    def value(f, q, c, r):
        params = make_lgssm_params(np.zeros(states), 10.0 * np.eye(states), f, q, c, r,
                                   dynamics_input_weights=into)
        found = lgssm_filter(params, y, pushes)
        return found.marginal_loglik, found.filtered_means

    given = (model['f'], model['q'], model['c'][None, :], model['r'].reshape(1, 1))
    alone = jax.jit(lambda *of: value(*of)[0])
    both = jax.jit(jax.value_and_grad(lambda *of: value(*of)[0], argnums=(0, 1, 2, 3)))
    spent = [1e6 * shortest(lambda c=call: jax.block_until_ready(c(*given))) / n
             for call in (alone, both)]
    means = np.asarray(value(*given)[1])
    ahead = means[:-1] @ model['f'].T + pushes[1:] @ into.T
    errors = (y[1:] - ahead @ model['c'][:, None])[n // 10 :]
    return {'us': spent[0], 'us_derivatives': spent[1], 'rms': float(np.sqrt(np.mean(errors**2)))}


if __name__ == '__main__':
    with np.load(sys.argv[1]) as stored:
        given = {name: stored[name] for name in stored.files}
    told = {
        'statsmodels': statsmodels_filter(given), 'filterpy': filterpy_filter(given),
        'dynamax': dynamax_filter(given),
    }
    sys.stdout.write(json.dumps(told) + '\n')
