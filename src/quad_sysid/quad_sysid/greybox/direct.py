"""The contract's base fitted to an IOData: the grey box as one call, beside the black-box ones.

Nothing is fitted here that fit.py does not fit; what the axis lacks (motors, battery, the other
axes) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import fit_base
from quad_sysid.greybox.structure import BASE_PARAMETERS
from quad_sysid.record import IOData


@dataclass(frozen=True)
class GreyBox:
    """rate' = drive - damping rate + bias, drive = gain command behind delay and lag.

    gain rad/s² per unit command, lag s, delay s, damping 1/s, bias rad/s².
    """

    parameter_names: tuple[str, ...]
    parameters: FloatArray
    """(5,)"""
    covariance: FloatArray
    """(5, 5) robust to coloured residuals; NaN rows for parameters at a bound."""
    converged: bool
    iterations: int
    rms: float
    """Free-run error over windows of 0.5 s of the data, rad/s."""
    dt: float

    @property
    def std(self) -> FloatArray:
        """(5,) standard errors, NaN at a bound."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def value(self, name: str) -> float:
        """One parameter by its name; raises BadInputError for another name."""
        if name not in self.parameter_names:
            raise BadInputError(
                'GreyBox', f'parameter must be one of {", ".join(self.parameter_names)}', name
            )
        return float(self.parameters[self.parameter_names.index(name)])


def fit_greybox(z: IOData, *, gyro_filter_hz: float | None = None) -> GreyBox:
    """Fit the base to command z.u and rate z.y by its free run over windows of 0.5 s.

    With `gyro_filter_hz` the model contains the sensor's 2nd-order Butterworth filter. Raises
    BadInputError where z holds too few windows or no excitation.
    """
    if gyro_filter_hz is not None and not 0.0 < gyro_filter_hz < 0.5 / z.dt:
        raise BadInputError(
            'greybox', f'gyro_filter_hz must be between 0 and {0.5 / z.dt:g} Hz', gyro_filter_hz
        )
    n = z.y.size
    control = np.zeros((n, 4))
    control[:, 1] = np.nan_to_num(z.u)
    spans = tuple((int(a), int(b)) for a, b in z.segments)
    data = AxisData(
        axis='roll', dt=z.dt, rate=z.y, angle=None, control=control, motors=np.zeros((n, 4)),
        other_rates=np.full((n, 2), np.nan), battery_v=None, gyro_filter_hz=gyro_filter_hz,
        stretches=spans, train=spans, validation=(),
    )
    try:
        fit, _, _ = fit_base(data, data.train)
    except NotInformativeError as error:
        raise BadInputError('greybox', str(error)) from error
    return GreyBox(
        parameter_names=tuple(spec.name for spec in BASE_PARAMETERS), parameters=fit.theta,
        covariance=fit.covariance, converged=fit.converged, iterations=fit.iterations,
        rms=fit.rms, dt=z.dt,
    )
