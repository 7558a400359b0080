"""Black-box identification of one axis: polynomial models, order search, validation, tests."""

from quad_sysid.blackbox.arx import OrderSearch, arx, search_arx
from quad_sysid.blackbox.excitation import delay_estimate, detrend, excitation_order
from quad_sysid.blackbox.frequency import FrequencyResponse, frequency_response
from quad_sysid.blackbox.polynomial import Model, polynomial_model
from quad_sysid.blackbox.residuals import ResidualTest, residual_test
from quad_sysid.blackbox.simulate import (
    compare,
    fit_percent,
    initial_state,
    predict,
    simulate,
    state_size,
)
from quad_sysid.blackbox.spectra import SpectralEstimate, coherence, spa
from quad_sysid.blackbox.step_a import StepARow, select, step_a

__all__ = [
    'FrequencyResponse',
    'Model',
    'OrderSearch',
    'ResidualTest',
    'SpectralEstimate',
    'StepARow',
    'arx',
    'coherence',
    'compare',
    'delay_estimate',
    'detrend',
    'excitation_order',
    'fit_percent',
    'frequency_response',
    'initial_state',
    'polynomial_model',
    'predict',
    'residual_test',
    'search_arx',
    'select',
    'simulate',
    'spa',
    'state_size',
    'step_a',
]
