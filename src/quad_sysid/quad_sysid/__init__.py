"""System identification of a quadrotor's axes from flights: what the model lacks, and models.

    import quad_sysid as qs
    result = qs.identify('my_flight', axes='roll')      # verdict, effects, model, errors, rivals
    print(result); result.plot('missing_torque'); result.save('out')
    z = qs.read_bag('my_flight').axis('roll', 'train')
    model = qs.bj(z, 2, 2, 2, 2, 3)

Names and orders are MATLAB's; nk = 1 is one sample of delay. Each name is loaded at its first use,
so that the import is fast and needs neither ROS nor matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quad_sysid.bags import read_bag as read_bag
    from quad_sysid.blackbox import (
        FrequencyResponse,
        LinearController,
        Model,
        OrderSearch,
        ResidualTest,
        SpectralEstimate,
        armax,
        arx,
        bj,
        cascade_controller,
        clriv,
        coherence,
        compare,
        delay_estimate,
        detrend,
        excitation_order,
        fit_percent,
        frequency_response,
        indirect,
        iv4,
        joint,
        n4sid,
        oe,
        polynomial_model,
        predict,
        residual_test,
        search_arx,
        simulate,
        spa,
    )
    from quad_sysid.effects import EFFECTS as EFFECTS
    from quad_sysid.errors import BadInputError, NotInformativeError, QuadSysidError
    from quad_sysid.model import GainProposal as GainProposal
    from quad_sysid.model.effect import Effect, Signals, Spec
    from quad_sysid.pipeline.direct import greybox
    from quad_sysid.record import IOData, Record, Segment
    from quad_sysid.result import (
        Identified,
        Result,
        evaluate,
        identify,
        read_model,
        separate,
    )
    from quad_sysid.signals import design_excitation, prbs

_HOMES = {
    'quad_sysid.bags': ('read_bag',),
    'quad_sysid.errors': ('BadInputError', 'NotInformativeError', 'QuadSysidError'),
    'quad_sysid.effects': ('EFFECTS',),
    'quad_sysid.model': ('GainProposal',),
    'quad_sysid.model.effect': ('Effect', 'Signals', 'Spec'),
    'quad_sysid.pipeline.direct': ('greybox',),
    'quad_sysid.result': (
        'Identified', 'Result', 'evaluate', 'identify', 'read_model', 'separate',
    ),
    'quad_sysid.signals': ('design_excitation', 'prbs'),
    'quad_sysid.record': ('IOData', 'Record', 'Segment'),
    'quad_sysid.blackbox': (
        'FrequencyResponse', 'LinearController', 'Model', 'OrderSearch', 'ResidualTest',
        'SpectralEstimate', 'armax', 'arx', 'bj', 'cascade_controller', 'clriv', 'coherence',
        'compare', 'delay_estimate', 'detrend', 'excitation_order', 'fit_percent',
        'frequency_response', 'indirect', 'iv4', 'joint', 'n4sid', 'oe', 'polynomial_model',
        'predict', 'residual_test', 'search_arx', 'simulate', 'spa',
    ),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    'EFFECTS',
    'BadInputError',
    'Effect',
    'FrequencyResponse',
    'GainProposal',
    'IOData',
    'Identified',
    'LinearController',
    'Model',
    'NotInformativeError',
    'OrderSearch',
    'QuadSysidError',
    'Record',
    'ResidualTest',
    'Result',
    'Segment',
    'Signals',
    'Spec',
    'SpectralEstimate',
    'armax',
    'arx',
    'bj',
    'cascade_controller',
    'clriv',
    'coherence',
    'compare',
    'delay_estimate',
    'design_excitation',
    'detrend',
    'evaluate',
    'excitation_order',
    'fit_percent',
    'frequency_response',
    'greybox',
    'identify',
    'indirect',
    'iv4',
    'joint',
    'n4sid',
    'oe',
    'polynomial_model',
    'prbs',
    'predict',
    'read_bag',
    'read_model',
    'residual_test',
    'search_arx',
    'separate',
    'simulate',
    'spa',
]


def __getattr__(name: str) -> object:
    """Load a public name from its home (PEP 562)."""
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
