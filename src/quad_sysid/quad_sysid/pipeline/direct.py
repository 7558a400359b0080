"""The base fitted to an IOData: the grey box as one call.

What the axis lacks (motors, battery, the other axes) is left out.
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
from quad_sysid.identified import Identified
from quad_sysid.model.data import axis_alone
from quad_sysid.pipeline.usable import check_moving
from quad_sysid.record import IOData


@dataclass(frozen=True)
class GreyBox(Identified):
    """The base: rate' = drive - damping rate + bias, drive = gain command behind delay and lag.

    gain rad/s² per unit command, lag s, delay s, damping 1/s, bias rad/s²; its covariance (5, 5)
    is robust to innovations that are not white, NaN rows for a lag or delay of nothing.
    """

    converged: bool = True
    rms: float = np.nan
    """Free-run error over windows of 0.5 s of the data, rad/s."""

    @property
    def std(self) -> FloatArray:
        """(5,) standard errors in the order of `parameter_names`, NaN where there is none."""
        return np.array([p.std for p in self.base], dtype=float)


def greybox(z: IOData, *, gyro_filter_hz: float | None = None) -> GreyBox:
    """Fit the base to command z.u and rate z.y by the likelihood of its innovations.

    With `gyro_filter_hz` the model contains the sensor's 2nd-order Butterworth filter. Raises
    BadInputError where z holds too few windows or no excitation.
    """
    if gyro_filter_hz is not None and not 0.0 < gyro_filter_hz < 0.5 / z.dt:
        raise BadInputError('greybox', f'gyro_filter_hz must be between 0 and {0.5 / z.dt:g} Hz',
                            gyro_filter_hz)
    spans = tuple((int(a), int(b)) for a, b in z.segments)
    data = axis_alone(np.nan_to_num(z.u), z.y, z.dt, spans, gyro_filter_hz)
    try:
        check_moving(data)
        problem = Problem(data, spans)
        fitted = best_base(problem)
    except (FloatingPointError, NotInformativeError) as error:
        raise BadInputError('greybox', str(error)) from error
    read = readings(problem, fitted)
    return GreyBox(data.axis, z.dt, gyro_filter_hz, read.base, parameter_names=read.names,
                   covariance=read.covariance, noise=noise_of(fitted), converged=fitted.converged,
                   rms=rms(Unseen(data, spans).errors(fitted)))
