"""The paper's Table 1 on one axis: which approaches the recorded signals allow, and their fits."""

from __future__ import annotations

import numpy as np

from quad_sysid.blackbox import (
    LinearController,
    Model,
    bj,
    cascade_controller,
    indirect,
    joint,
)
from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import CascadeGains, derivative_weight
from quad_sysid.pipeline.answer import Approach
from quad_sysid.pipeline.blackbox_part import NOISE_ORDER, ORDERS, Fits, tried
from quad_sysid.record import IOData

KNOWN_CONTROLLER_PCT = 70.0
"""Fit of the known controller's own command to the recorded one below which it is not known."""


def approaches(
    z: IOData, gains: CascadeGains | None, *, behind_attitude: bool, one_loop: bool,
    closed: bool | None,
) -> tuple[tuple[Approach, ...], LinearController | None]:
    """Judge each approach by the signals it needs; the controller where `indirect` is possible.

    `behind_attitude`: the external reference is the attitude set-point and not an excitation
    that was added behind C1 or C2. `one_loop`: all training was flown with the same gains.
    """
    no = ''
    if closed is False:
        no = 'no feedback in the data: the direct approach has nothing to avoid'
    elif z.r is None:
        no = 'no external reference that moves: record /setpoint/attitude or /excitation/applied'
    elif not one_loop:
        no = 'the training was flown with several sets of gains, which are several loops'
    known, told = None, no
    if not no and gains is None:
        told = '/gains/active does not say the controller'
    elif not no and not behind_attitude:
        told = 'the excitation acts behind C1 or C2, not on the attitude reference'
    elif not no and gains is not None:
        known, told = _known(z, gains)
    return (
        Approach('direct', possible=True, because='command and rate are recorded'),
        Approach('indirect', possible=known is not None, because=told),
        Approach('joint', possible=not no,
                 because=no or 'command, rate and reference are recorded'),
    ), known


def _known(z: IOData, gains: CascadeGains) -> tuple[LinearController | None, str]:
    """The controller, if its own command is the recorded one, and what was found."""
    ways = [controller(gains, z.dt, trapezoid=trapezoid) for trapezoid in (True, False)]
    known = max(ways, key=lambda way: reproduced(z, way))
    fit = reproduced(z, known)
    if fit < KNOWN_CONTROLLER_PCT:
        return None, (
            f'the controller of /gains/active gives only {max(fit, 0.0):.0f} % of the recorded '
            'command; limits or another loop act as well'
        )
    return known, f'reference and rate are recorded, {fit:.0f} % of the command is the controller'


def controller(gains: CascadeGains, dt: float, *, trapezoid: bool = True) -> LinearController:
    """C1 and C2 without their limits; the far end's angle by trapezoids or by rectangles."""
    return cascade_controller(
        angle_kp=gains.angle_kp, rate_kp=gains.rate_kp, rate_ki=gains.rate_ki,
        rate_kd=gains.rate_kd, d_weight=derivative_weight(gains.d_filter_hz, dt), dt=dt,
        trapezoid=trapezoid,
    )


def reproduced(z: IOData, known: LinearController) -> float:
    """Fit in percent of the known controller's command to the recorded one, drift aside.

    The angle's start and the gyro's bias are not known to the running sum, so the recorded and
    the computed command are compared in their changes over a tenth of a second.
    """
    if z.r is None:
        return 0.0
    lag = max(1, round(0.1 / z.dt))
    recorded: list[FloatArray] = []
    computed: list[FloatArray] = []
    for a, b in z.segments:
        if b - a > 2 * lag:
            u = known.command(z.r[a:b], z.y[a:b])
            recorded.append(z.u[a + lag : b] - z.u[a : b - lag])
            computed.append(u[lag:] - u[:-lag])
    if not recorded:
        return 0.0
    one, other = np.concatenate(recorded), np.concatenate(computed)
    spread = float(np.linalg.norm(one - one.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(one - other)) / spread) if spread > 0.0 else 0.0


def fit_others(
    z: IOData, fits: Fits, possible: tuple[Approach, ...], known: LinearController | None
) -> tuple[tuple[Model, ...], tuple[str, ...]]:
    """Fit the plant by every approach but the direct one that is possible; models and refusals."""
    refused: list[str] = []
    nk, n = fits.nk, fits.order
    models: tuple[Model, ...] = ()
    start = next((m for m in fits.models if m.structure == 'BJ'), None)
    names = {one.name for one in possible if one.possible}
    if 'joint' in names:
        models += tried(
            refused, lambda: joint(z, lambda data: bj(data, n, NOISE_ORDER, NOISE_ORDER, n, nk))
        )
    if known is not None and 'indirect' in names:
        found = tried(refused, lambda: indirect(z, n, n, nk, known, start=start))
        if n > ORDERS[0] and not any(model.converged for model in found):
            found = tried(refused, lambda: indirect(z, ORDERS[0], ORDERS[0], nk, known)) or found
        models += found
    return models, tuple(refused)
