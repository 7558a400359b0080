"""What an LQR gives besides its square wave: a torque step, noise at the motors, bandwidth.

The same figures as assess.py has for the cascade, on the linear plant. Nothing is designed here.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import trapezoid

from quad_sysid.contract import FloatArray
from quad_sysid.loop.plant import LoopPlant, dynamics, exact_step, slopes_at, state_space
from quad_tuning.assess import TORQUE_STEP, TORQUE_STEP_S
from quad_tuning.ensemble import AMPLITUDES, Ensemble
from quad_tuning.lqr import LqrController, simulate_lqr


def disturbance(plant: LoopPlant, controller: LqrController) -> float:
    """RMS angle under a torque step of TORQUE_STEP, rad."""
    slopes = slopes_at(plant, *AMPLITUDES[0])
    a, b, _ = dynamics(plant, slopes)
    _, push = exact_step(a, b, np.array(plant.dt))
    model = state_space(plant, slopes)
    torque = np.zeros(model.a.shape[0])
    torque[: a.shape[0]] = TORQUE_STEP * push[:, 1]
    n = round(TORQUE_STEP_S / plant.dt)
    angle = simulate_lqr(model, controller, np.zeros(n), push=torque)
    return float(np.sqrt(np.mean(angle**2)))


def noise_gain(controller: LqrController, nominal: Ensemble) -> float:
    """RMS of the control per RMS of white noise on the measured rate, 1/(rad/s)."""
    omega = nominal.omega
    control = controller.response(omega)
    loop = -np.einsum('of,of->f', control, nominal.response[:, 0])
    gain: FloatArray = np.abs(control[0] / (1.0 + loop))
    return float(np.sqrt(trapezoid(gain**2, omega) / (omega[-1] - omega[0])))
