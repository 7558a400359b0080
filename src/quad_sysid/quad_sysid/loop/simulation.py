"""The closed loop over time, compiled: the cascade around a LoopPlant or a polynomial model.

Exact within a cycle for the linear plant; curves (friction, pendulum) take as many Heun steps per
cycle as their steepest slope needs. The controller is that of cascade.py with its limits.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop import kernels
from quad_sysid.loop.cascade import CascadeGains, derivative_weight
from quad_sysid.loop.plant import Curve, LoopPlant, Slopes, dynamics, exact_step
from quad_sysid.model import AxisModel

MOST_STEPS = 64
STEP_TIMES_SLOPE = 0.2


class LoopResponse(NamedTuple):
    """(n,) each: measured angle (rad) and rate (rad/s) at the start of a cycle, outputs in it.

    control is the output of C2 (normalised command, the plant's input), rate_reference of C1
    (rad/s).
    """

    angle: FloatArray
    rate: FloatArray
    control: FloatArray
    rate_reference: FloatArray


def _table(curve: Curve | None) -> FloatArray:
    if curve is None:
        return np.zeros(kernels.EMPTY)
    return np.concatenate(([curve.x[0], curve.x[1] - curve.x[0]], curve.y))


def constants(gains: CascadeGains, dt: float) -> kernels.Constants:
    """The cascade's numbers for the kernels, with a control cycle of dt s."""
    known = {**vars(gains), 'd_weight': derivative_weight(gains.d_filter_hz, dt), 'dt': dt}
    return kernels.Constants(**{name: float(known[name]) for name in kernels.Constants._fields})


@lru_cache(maxsize=32)
def _cycle(plant: LoopPlant) -> kernels.Cycle:
    """The plant's matrices and tables, cached: a search uses one plant hundreds of times."""
    a, b, c = dynamics(plant, Slopes())
    parts = np.array([plant.rest_delay_s, plant.dt - plant.rest_delay_s])
    steps = np.ceil(_steps_a_cycle(plant) * parts / plant.dt - 1e-9)
    split = np.maximum(1, steps).astype(np.int64)
    if parts[0] < 1e-9 * plant.dt:
        split[0] = 0
        parts = np.array([plant.dt, plant.dt])
    phi, gamma = exact_step(a, b, parts / np.maximum(split, 1))
    return kernels.Cycle(phi=np.ascontiguousarray(phi), drive=np.ascontiguousarray(gamma[..., 0]),
                         push=np.ascontiguousarray(gamma[..., 1]), split=split,
                         whole=plant.whole_delay, rate_output=int(np.argmax(c[0])),
                         angle_output=int(np.argmax(c[1])), rate_table=_table(plant.rate_curve),
                         angle_table=_table(plant.angle_curve),
                         command_table=_table(plant.command_curve))


def _signal(values: npt.ArrayLike | None, n: int, name: str) -> FloatArray:
    if values is None:
        return np.zeros(n)
    array = np.ascontiguousarray(np.broadcast_to(np.asarray(values, dtype=float), (n,)))
    if not np.isfinite(array).all():
        raise BadInputError('simulate', f'{name} must be finite')
    return array


def _checked_reference(reference: npt.ArrayLike, dt: float, plant_dt: float) -> FloatArray:
    array = np.ascontiguousarray(np.asarray(reference, dtype=float))
    if array.ndim != 1 or array.size == 0 or not np.isfinite(array).all():
        raise BadInputError('simulate', 'the reference must be (n,), finite, n > 0', array.shape)
    if not math.isclose(dt, plant_dt, rel_tol=1e-6):
        raise BadInputError('simulate', f"dt must be the plant's {plant_dt} s", dt)
    return array


def _steps_a_cycle(plant: LoopPlant) -> int:
    """Number of Heun steps in a cycle."""
    curves = [c for c in (plant.rate_curve, plant.angle_curve) if c is not None]
    if not curves:
        return 1
    steepest = max(c.steepest for c in curves)
    return int(np.clip(np.ceil(plant.dt * steepest / STEP_TIMES_SLOPE), 2, MOST_STEPS))


def simulate_cascade(
    plant: LoopPlant | AxisModel, gains: CascadeGains, reference_angle: npt.ArrayLike, dt: float,
    noise: npt.ArrayLike | None = None, disturbance: npt.ArrayLike | None = None, *,
    rate_excitation: npt.ArrayLike | None = None, control_excitation: npt.ArrayLike | None = None,
    initial_angle: float = 0.0, initial_rate: float = 0.0, angle_lead_s: float = 0.0,
) -> LoopResponse:
    """Simulate the cascade around a plant, or a model's, for an angle reference (n,), rad.

    noise (n,) rad/s is on the measured rate; disturbance (n,) or a number, rad/s², acts on the
    axis and is held over the cycle. rate_excitation and control_excitation (n,) are added after
    the limits of C1 and C2, as in the firmware; the reference contains an excitation of the
    attitude. The drive starts at zero. angle_lead_s is the lead of the measured angle over the
    rate's integral (`angle_lead_s`). Raises BadInputError for wrong shapes, values that are not
    finite, and a dt that is not the plant's.
    """
    if isinstance(plant, AxisModel):
        from quad_sysid.loop.from_model import loop_plant

        plant = loop_plant(plant)
    reference = _checked_reference(reference_angle, dt, plant.dt)
    n = reference.size
    signals = np.stack((reference, _signal(noise, n, 'noise'),
                        plant.bias + _signal(disturbance, n, 'disturbance'),
                        _signal(rate_excitation, n, 'rate_excitation'),
                        _signal(control_excitation, n, 'control_excitation')))
    cycle = _cycle(plant)
    state = np.zeros(cycle.phi.shape[1])
    state[1], state[2] = initial_rate, initial_angle
    if plant.gyro_filter_hz is not None:
        behind = np.sqrt(2.0) / (2.0 * np.pi * plant.gyro_filter_hz)
        state[3], state[4] = initial_rate, initial_angle - behind * initial_rate
    out = np.zeros((4, n))
    kernels.run_plant(constants(gains, plant.dt), cycle, signals, state, out, float(angle_lead_s))
    return LoopResponse(*out)


def simulate_polynomial_cascade(
    A: npt.ArrayLike, B: npt.ArrayLike, gains: CascadeGains, reference: npt.ArrayLike, dt: float,
    *, noise: npt.ArrayLike | None = None, angle_lead_s: float = 0.0,
) -> LoopResponse:
    """Simulate the cascade around A(q) rate = B(q) u (the paper's step B).

    A (na + 1,) with A[0] != 0; B (m,) in powers of q^-1 from q^0, its leading zeros are the
    delay. The angle is the trapezoidal sum of the rate, ahead by angle_lead_s. A model without
    delay would need u before it is known: BadInputError.
    """
    array = _checked_reference(reference, dt, dt)
    a = np.asarray(A, dtype=float)
    b = np.asarray(B, dtype=float)
    if a.ndim != 1 or a.size == 0 or a[0] == 0 or not np.isfinite(a).all():
        raise BadInputError('simulate', 'A must be 1-D, finite, with A[0] not 0')
    if not np.isfinite(b).all() or (b.size and b[0] != 0):
        raise BadInputError('simulate', 'B must be finite and act after one cycle at least',
                            remedy='use nk >= 1')
    out = np.zeros((4, array.size))
    signals = np.stack((array, _signal(noise, array.size, 'noise')))
    kernels.run_polynomial(constants(gains, dt), signals, a / a[0], b / a[0], out,
                           float(angle_lead_s))
    return LoopResponse(*out)


BELIEVED = 0.9
"""Least share of the angle's steps that a lead must explain."""


def angle_lead_s(angle: FloatArray | None, rate: FloatArray, dt: float) -> float:
    """Lead in s, -dt/2..dt/2, of angle (n,) rad over the integral of rate (n,) rad/s.

    Least squares of w in a(k) - a(k-1) = dt (w rate(k) + (1 - w) rate(k-1)); the lead is
    (w - 1/2) dt: 0 for trapezoids, dt/2 for rectangles with the newest rate. It is 0 where the
    angle is unknown or not the integral of this rate.
    """
    if angle is None:
        return 0.0
    step = np.diff(angle) - dt * rate[:-1]
    turn = dt * np.diff(rate)
    known = np.isfinite(step) & np.isfinite(turn)
    step, turn = step[known], turn[known]
    power = float(turn @ turn)
    if not power > 0.0:
        return 0.0
    share = float(turn @ step) / power
    left = step - share * turn
    if float(left @ left) > (1.0 - BELIEVED) * float(step @ step):
        return 0.0
    return (min(max(share, 0.0), 1.0) - 0.5) * dt
