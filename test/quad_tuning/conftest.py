"""An identified model of the paper's aircraft, as identification would hand it on."""

from functools import partial

import numpy as np
import pytest

from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel, NoiseEstimate, Parameter
from quad_tuning import ensemble

NAMES = ('gain', 'lag', 'delay', 'damping', 'bias')
VALUES = {'gain': 450.0, 'lag': 0.043, 'delay': 0.008, 'damping': 0.4, 'bias': 0.1}
STDS = {'gain': 5.0, 'lag': 0.0006, 'delay': 0.0004, 'damping': 0.05, 'bias': 0.02}
UNITS = ('rad/s²', 's', 's', '1/s', 'rad/s²')
NOISE = NoiseEstimate({}, 0.02, 1e4, 0.015, 0.01)


def build_model(axis='roll', effects=(), stds=None, **values):
    values = VALUES | values
    stds = STDS | (stds or {})
    base = tuple(Parameter(n, values[n], stds[n], u) for n, u in zip(NAMES, UNITS, strict=True))
    return AxisModel(
        axis=axis, dt=0.004, gyro_filter_hz=42.0, base=base, effects=tuple(effects),
        parameter_names=NAMES, covariance=np.diag([stds[n] ** 2 for n in NAMES]),
        active_gains={**CascadeGains.default(axis).to_mapping(axis, constants=True),
                      f'{axis}.sag.exponent': 0.0, f'{axis}.sag.reference_v': 0.0},
        noise=NOISE, mean_battery_v=11.4,
    )  # fmt: skip


@pytest.fixture(scope='session')
def model():
    """Factory: build_model(axis=..., effects=..., stds={...}, gain=..., ...)."""
    return build_model


@pytest.fixture
def few_draws(monkeypatch):
    """A design over a quarter of its draws, where their number is not the matter."""
    few = partial(ensemble.build, count=ensemble.DRAWS // 4)
    monkeypatch.setattr(ensemble, 'build', few)
