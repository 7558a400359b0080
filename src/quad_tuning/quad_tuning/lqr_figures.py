"""What an LQR gives besides its square wave: a torque step, noise at the motors, what it promises.

The same figures as assess.py and promise.py have for the cascade, on the linear plant. Nothing is
designed here.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import trapezoid

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import CascadeGains, open_loop
from quad_sysid.loop.plant import LoopPlant, dynamics, exact_step, slopes_at, state_space
from quad_tuning.assess import TORQUE_STEP, TORQUE_STEP_S
from quad_tuning.ensemble import AMPLITUDES, Ensemble
from quad_tuning.lqr import loop_gain
from quad_tuning.promise import ratios
from quad_tuning.state_feedback import StateFeedback, controller_response, simulate


def disturbance(plant: LoopPlant, controller: StateFeedback) -> float:
    """RMS angle under a torque step of TORQUE_STEP, rad."""
    slopes = slopes_at(plant, *AMPLITUDES[0])
    a, b, _ = dynamics(plant, slopes)
    _, push = exact_step(a, b, np.array(plant.dt))
    model = state_space(plant, slopes)
    torque = np.zeros(model.a.shape[0])
    torque[: a.shape[0]] = TORQUE_STEP * push[:, 1]
    n = round(TORQUE_STEP_S / plant.dt)
    angle, _ = simulate(model, controller, np.zeros(n), push=torque)
    return float(np.sqrt(np.mean(angle**2)))


def noise_gain(controller: StateFeedback, nominal: Ensemble) -> float:
    """RMS of the control per RMS of white noise on the measured rate, 1/(rad/s)."""
    omega = nominal.omega
    response = controller_response(controller.dynamics(), omega, controller.dt)
    loop = -np.einsum('of,of->f', response, nominal.response[:, 0])
    gain: FloatArray = np.abs(response[0] / (1.0 + loop))
    return float(np.sqrt(trapezoid(gain**2, omega) / (omega[-1] - omega[0])))


def promise(
    loops: Ensemble, before: CascadeGains, after: StateFeedback, lag_s: float
) -> dict[str, float]:
    """As promise.py's, from the cascade that flew to the feedback."""
    old = open_loop(before, loops.response, loops.omega, loops.cycle.dt)
    new = loop_gain(after.dynamics(), loops)
    forward = controller_response(after.dynamics(), loops.omega, loops.cycle.dt)[1]
    peak = np.abs(loops.response[1] * forward / (1.0 + new)).max()
    return {**ratios(loops, old, new, lag_s), 'peak': float(peak)}
