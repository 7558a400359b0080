"""An identified model run freely on commands of one's own: no noise, no feedback, no recording."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.estimate.stored import completed
from quad_sysid.model import AxisModel
from quad_sysid.model.data import AxisData, Windows
from quad_sysid.model.plant import Flight, Prediction


def simulate(
    model: AxisModel,
    u: npt.ArrayLike,
    x0: tuple[float, float] = (0.0, 0.0),
    *,
    throttle: npt.ArrayLike | None = None,
    battery_v: npt.ArrayLike | None = None,
) -> FloatArray:
    """(n,) rate as the gyro would give it, rad/s, for commands `u` (n,), one a control cycle.

    `x0` is the rate (rad/s) and the angle (rad) at the first command; motors and filter are at
    rest there. `throttle` (U1) and `battery_v` (V) are needed by effects that depend on them; one
    value or (n,). The other axes stand still. Raises BadInputError for signals that do not fit.
    """
    command = np.asarray(u, dtype=np.float64)
    if command.ndim != 1 or command.size < 2 or not np.isfinite(command).all():
        raise BadInputError('simulate', 'u must be (n,) finite commands, n at least 2',
                            f'shape {command.shape}')
    n, rate, angle = command.size + 1, float(x0[0]), float(x0[1])  # one cycle before, at rest
    stored = completed(model)
    for part in stored.structure.parts:
        if 'battery' in part.effect.signals and battery_v is None:
            raise BadInputError('simulate', f'{part.effect.name} needs battery_v')
    control = np.zeros((n, 4))
    control[:, 0] = _like(throttle, n, 'throttle', 0.0)
    control[1:, 1 + AXES.index(model.axis)] = command
    data = AxisData(
        axis=model.axis, dt=model.dt, rate=np.zeros(n), angle=np.full(n, angle), control=control,
        motors=np.zeros((n, 4)), other_rates=np.zeros((n, 2)),
        battery_v=None if battery_v is None else _like(battery_v, n, 'battery_v'),
        gyro_filter_hz=model.gyro_filter_hz, stretches=((0, n),), train=((0, n),), validation=(),
    )
    flight = Flight(data, ((0, n),))
    flight.angle = np.full(n, angle - flight.late * rate)  # the model takes angles for late
    found = flight.filter_of(stored.structure, stored.theta, 0.0)
    states = np.zeros((n, 4 + 2 * stored.structure.lines))
    filtered = flight.sensor.step[1]
    settled = rate * (filtered[0] + filtered[2:].sum()) / (1.0 - filtered[1])
    states[1, :4] = rate, 0.0, rate, settled
    start = Prediction(np.zeros(n), None, states, found, np.full(n, rate))
    once = Windows(np.ones(1, dtype=np.int64), n - 1, np.zeros(1, dtype=np.int64))
    rates = flight.free_run(stored.structure, stored.theta, once, prediction=start)
    return np.asarray(rates[0])


def _like(value: npt.ArrayLike | None, n: int, name: str, default: float = np.nan) -> FloatArray:
    """One value, or (n - 1,) behind a cycle like its first, as (n,)."""
    given = np.asarray(default if value is None else value, dtype=np.float64)
    if given.shape not in ((), (n - 1,)) or not np.isfinite(given).all():
        raise BadInputError('simulate', f'{name} must be one finite value or as long as u',
                            given.shape)
    return np.full(n, given) if given.ndim == 0 else np.concatenate((given[:1], given))
