"""Time one likelihood by other libraries' filters, in a Python that has them.

    PYTHON bench/effects_peers.py MODEL.npz

Started by effects_speed.py with the same linear model: `statsmodels` (compiled) and `filterpy`
(numpy), each left out where it is missing. Ends with one JSON object: us a sample for one value of
the likelihood, and the RMS of the innovations.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np


def statsmodels_filter(model: dict[str, np.ndarray]) -> dict[str, float]:
    """Its state-space filter with a known input in every cycle, compiled."""
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
    peer.loglike()
    began = time.perf_counter()
    peer.loglike()
    spent = time.perf_counter() - began
    errors = peer.filter().forecasts_error[0, n // 10 :]
    return {'us': 1e6 * spent / n, 'rms': float(np.sqrt(np.mean(errors**2)))}


def filterpy_filter(model: dict[str, np.ndarray]) -> dict[str, float]:
    """Its KalmanFilter, a call of predict and one of update a sample."""
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError:
        return {}
    n, states = model['pushes'].size, model['f'].shape[0]
    peer = KalmanFilter(states, 1, 1)
    peer.F, peer.H, peer.Q, peer.R = model['f'], model['c'][None, :], model['q'], model['r']
    peer.B = np.eye(states)[:, :1]
    errors, total = np.empty(n), 0.0
    began = time.perf_counter()
    for k in range(n):
        peer.update(model['y'][k])
        errors[k] = peer.y[0, 0]
        total += peer.log_likelihood
        peer.predict(model['pushes'][k])
    spent = time.perf_counter() - began
    return {'us': 1e6 * spent / n, 'rms': float(np.sqrt(np.mean(errors[n // 10 :] ** 2)))}


if __name__ == '__main__':
    with np.load(sys.argv[1]) as stored:
        given = {name: stored[name] for name in stored.files}
    told = {'statsmodels': statsmodels_filter(given), 'filterpy': filterpy_filter(given)}
    sys.stdout.write(json.dumps(told) + '\n')
