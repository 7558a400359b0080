"""The base fitted to an IOData: the grey box as one call.

The fit is that of estimate/fit.py, without motors, battery and the other axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Unseen, rms
from quad_sysid.discover.base import best_base
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate.fit import Problem
from quad_sysid.estimate.stored import noise_of, readings
from quad_sysid.model import NoiseEstimate
from quad_sysid.model.data import axis_alone
from quad_sysid.pipeline.usable import check_moving
from quad_sysid.record import IOData


@dataclass(frozen=True)
class GreyBox:
    """rate' = drive - damping rate + bias + d, drive = gain command behind delay and lag.

    gain rad/s² per unit command, lag s, delay s, damping 1/s, bias rad/s².
    """

    parameter_names: tuple[str, ...]
    parameters: FloatArray
    """(5,)"""
    covariance: FloatArray
    """(5, 5) robust to innovations that are not white, behind the filter as it is modelled; NaN
    rows for a lag or delay of nothing."""
    noise: NoiseEstimate
    """Torque disturbance and measurement noise."""
    converged: bool
    iterations: int
    rms: float
    """Free-run error over windows of 0.5 s of the data, rad/s."""
    dt: float

    @property
    def std(self) -> FloatArray:
        """(5,) standard errors, NaN where there is none."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def value(self, name: str) -> float:
        """One parameter by its name; raises BadInputError for another name."""
        if name not in self.parameter_names:
            raise BadInputError(
                'GreyBox', f'parameter must be one of {", ".join(self.parameter_names)}', name
            )
        return float(self.parameters[self.parameter_names.index(name)])


def greybox(z: IOData, *, gyro_filter_hz: float | None = None) -> GreyBox:
    """Fit the base to command z.u and rate z.y by the likelihood of its innovations.

    With `gyro_filter_hz` the model contains the sensor's 2nd-order Butterworth filter. Raises
    BadInputError where z holds too few windows or no excitation.
    """
    if gyro_filter_hz is not None and not 0.0 < gyro_filter_hz < 0.5 / z.dt:
        raise BadInputError(
            'greybox', f'gyro_filter_hz must be between 0 and {0.5 / z.dt:g} Hz', gyro_filter_hz
        )
    spans = tuple((int(a), int(b)) for a, b in z.segments)
    data = axis_alone(np.nan_to_num(z.u), z.y, z.dt, spans, gyro_filter_hz)
    try:
        check_moving(data)
        problem = Problem(data, spans)
        fitted = best_base(problem)
    except (FloatingPointError, NotInformativeError) as error:
        raise BadInputError('greybox', str(error)) from error
    told = readings(problem, fitted)
    return GreyBox(
        parameter_names=told.names, parameters=np.array([p.value for p in told.base]),
        covariance=told.covariance, noise=noise_of(fitted), converged=fitted.converged,
        iterations=fitted.steps, rms=rms(Unseen(data, spans).errors(fitted)), dt=z.dt,
    )

