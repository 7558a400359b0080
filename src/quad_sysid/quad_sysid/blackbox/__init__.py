"""Black-box identification of one axis: polynomial models, order search, validation, tests."""

from quad_sysid.blackbox.approaches import LinearController, cascade_controller, indirect, joint
from quad_sysid.blackbox.arx import OrderSearch, arx, delay_estimate, search_arx
from quad_sysid.blackbox.frequency import (
    FrequencyResponse,
    SpectralEstimate,
    coherence,
    frequency_response,
    spa,
)
from quad_sysid.blackbox.instruments import clriv, iv4
from quad_sysid.blackbox.model import Model, polynomial_model
from quad_sysid.blackbox.prediction_error import armax, bj, oe
from quad_sysid.blackbox.regression import detrend, excitation_order
from quad_sysid.blackbox.residuals import ResidualTest, innovation_test, residual_test
from quad_sysid.blackbox.simulate import (
    compare,
    fit_percent,
    horizon_errors,
    initial_state,
    predict,
    simulate,
)
from quad_sysid.blackbox.step_a import StepARow, step_a

__all__ = ['FrequencyResponse', 'LinearController', 'Model', 'OrderSearch', 'ResidualTest',
           'SpectralEstimate', 'StepARow', 'armax', 'arx', 'bj', 'cascade_controller', 'clriv',
           'coherence', 'compare', 'delay_estimate', 'detrend', 'excitation_order', 'fit_percent',
           'frequency_response', 'horizon_errors', 'indirect', 'initial_state', 'innovation_test',
           'iv4', 'joint', 'oe', 'polynomial_model', 'predict', 'residual_test', 'search_arx',
           'simulate', 'spa', 'step_a']
