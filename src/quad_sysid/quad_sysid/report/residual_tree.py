"""What is left of each model, for report.json: values only, the largest of a few picked out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.pipeline.answer import MissingTorque, Residual

MOST_PEAKS = 6
MODELS = ('before', 'after', 'blackbox')


def residual_tree(found: Mapping[str, Residual]) -> dict[str, Any]:
    """By model, in the order before, after, black box; null where there was too little to test."""
    return {name: _one(found[name]) if name in found else None for name in MODELS}


def _one(residual: Residual) -> dict[str, Any]:
    test = residual.test
    tree: dict[str, Any] = {
        'data': 'held-out', 'samples': test.samples, 'rms': residual.rms, 'unit': 'rad/s',
        'confidence': test.confidence,
        'white': bool(test.residual_white), 'p_white': _number(test.p_white),
        'autocorrelation_bound': _number(test.autocorrelation_bound),
        'largest_autocorrelation': _largest(test.lags[1:], test.autocorrelation[1:]),
        'uncorrelated_with_input': bool(test.residual_uncorrelated_with_input),
        'p_input': _number(test.p_input),
        'cross_bound': _number(test.cross_bound),
        'largest_cross_correlation': _largest(test.cross_lags, test.cross_correlation),
        'peaks': [
            {'frequency_hz': f, 'over_surroundings_db': 10.0 * math.log10(ratio)}
            for f, ratio in residual.peaks[:MOST_PEAKS]
        ],
    }
    if residual.missing is not None:
        tree['missing_torque'] = _torque(residual.missing)
    return tree


def _torque(missing: MissingTorque) -> dict[str, Any]:
    at_s, value = missing.largest
    return {
        'unit': 'rad/s²', 'rms': missing.rms, 'expected_rms': missing.expected_rms,
        'largest': value, 'at_s': at_s,
    }


def _largest(lags: np.ndarray, values: FloatArray) -> dict[str, Any]:
    i = int(np.argmax(np.abs(values)))
    return {'lag_samples': int(lags[i]), 'value': _number(float(values[i]))}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
