"""Whether an identified model allows a design at all; each check refuses with its reason.

Pure checks on an AxisModel. What gains may be stands in bounds.py.
"""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.loop.cascade import CONTRACT_NAMES, TUNED, CascadeGains
from quad_sysid.model import AxisModel
from quad_tuning.bounds import check_bounds, check_polarity
from quad_tuning.errors import DesignRefusedError

LARGEST_RELATIVE_STD = {'gain': 0.2, 'lag': 0.4}
"""Standard error over value beyond which no margin over draws is worth anything."""
LARGEST_DELAY_STD_CYCLES = 1.5
BAND_REACH = 2.0
"""How far beyond its trusted band a grey-box model is believed: one octave."""


def check_model(model: AxisModel) -> None:
    """Refuse a model with the wrong sign, without covariance, not finite or too uncertain."""
    check_polarity(model)
    named = [(p.name, p.value) for p in model.base]
    named += [(f'{e.name}.{p.name}', p.value) for e in model.effects for p in e.parameters]
    for name, value in named:
        if not math.isfinite(value):
            raise DesignRefusedError(f'{model.axis}: {name} is {value}; identify again')
    if model.covariance is None or not model.parameter_names:
        raise DesignRefusedError(
            f'{model.axis}: the model has no covariance, so no margin can be assured'
        )
    size = len(model.parameter_names)
    if np.shape(model.covariance) != (size, size):
        raise DesignRefusedError(
            f'{model.axis}: the covariance is {np.shape(model.covariance)}, the parameters are '
            f'{size}; identify again'
        )
    _check_uncertainty(model)


def _check_uncertainty(model: AxisModel) -> None:
    stds = np.sqrt(np.maximum(np.diag(np.asarray(model.covariance, dtype=float)), 0.0))
    known = dict(zip(model.parameter_names, stds, strict=True))
    for name, largest in LARGEST_RELATIVE_STD.items():
        value, std = model.value(name), float(known.get(name, np.nan))
        if name == 'gain' and not math.isfinite(std):
            raise DesignRefusedError(f'{model.axis}: the covariance lacks the plant gain')
        if std > max(largest * abs(value), model.dt if name == 'lag' else 0.0):
            raise DesignRefusedError(
                f'{model.axis}: {name} {value:.4g} +- {std:.2g} is too uncertain (at most '
                f'{100 * largest:.0f} %); fly a longer or stronger excitation'
            )
    delay_std = float(known.get('delay', np.nan))
    if delay_std > LARGEST_DELAY_STD_CYCLES * model.dt:
        raise DesignRefusedError(
            f'{model.axis}: delay {model.value("delay"):.4g} +- {delay_std:.2g} s is too '
            f'uncertain (at most {LARGEST_DELAY_STD_CYCLES * model.dt:.2g} s); '
            'fly a faster excitation'
        )


def flown_gains(model: AxisModel) -> CascadeGains:
    """The gains of the flight; refused where the bag does not say, or they are out of bounds."""
    names = [f'{model.axis}.{CONTRACT_NAMES[field]}' for field in TUNED]
    missing = [name for name in names if name not in model.active_gains]
    if model.active_gains.get(f'{model.axis}.lqr.share', 0.0) > 0.0:
        raise DesignRefusedError(
            f'{model.axis}: the flight was flown by state feedback ({model.axis}.lqr.share is not '
            '0); a design starts from the cascade: set the share to 0 and fly again'
        )
    if missing:
        raise DesignRefusedError(
            f"{model.axis}: the flight's gains are not known ({missing[0]} missing); "
            'record /gains/active'
        )
    check_bounds({name: model.active_gains[name] for name in names})
    return CascadeGains.from_mapping(model.active_gains, model.axis)


def check_band(model: AxisModel, crossover_rad_s: float) -> None:
    """Refuse a model whose trusted band does not reach the crossover of the loop that flew."""
    band = model.trusted_band_rad_s
    if band is None or not math.isfinite(crossover_rad_s):
        return
    low, high = band
    if not low / BAND_REACH <= crossover_rad_s <= high * BAND_REACH:
        raise DesignRefusedError(
            f'{model.axis}: the model is trusted in {low:.2g} .. {high:.2g} rad/s, the loop '
            f'crosses over at {crossover_rad_s:.2g} rad/s; excite that band'
        )
