"""LQR for the angle: discrete, delay as states, integral action, observer.

State feedback on the linear plant of quad_sysid.loop.plant (drive, rate, angle, gyro filter, the
commands under way) and on the integral of the angle error; weights by Bryson's rule. A Kalman
filter estimates the states from the measured rate and angle. The loop is slowed until every loop
of the ensemble keeps its margins. The cascade is not touched here (pid.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import Margins, margins
from quad_sysid.loop.figures import SquareFigures, square_figures
from quad_sysid.loop.plant import ComplexArray, LoopPlant, StateSpace, slopes_at, state_space
from quad_tuning.assess import SQUARE_AMPLITUDE_RAD, reference_square
from quad_tuning.ensemble import AMPLITUDES, Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.pid import Requirements, meets

TRUE_RATE, TRUE_ANGLE = 1, 2
"""Places in the plant's state."""
FASTEST = 0.05
RAISE = 1.4
ROUNDS = 36


@dataclass(frozen=True)
class Weights:
    """Bryson's rule: the largest value of each that is acceptable; its weight is 1 / max²."""

    angle_rad: float = 0.1
    rate_rad_s: float = 1.0
    integral_rad_s: float = 0.2
    control: float = 0.1


@dataclass(frozen=True)
class Noise:
    """What the observer expects."""

    torque: float = 50.0
    """RMS of the torque noise over one cycle, rad/s²."""
    rate: float = 0.01
    """RMS, rad/s."""
    angle: float = 0.002
    """RMS, rad."""


@dataclass(frozen=True)
class LqrController:
    """u = -feedback x_hat - integral_gain xi, held within +-output_limit.

    Each cycle: x_hat = x + observer (y - c x) with y = (rate, angle); u as above;
    x = a x_hat + b u; xi += dt (reference - angle), held while u is at its limit.
    """

    a: FloatArray
    """(n, n)."""
    b: FloatArray
    """(n, 1)."""
    c: FloatArray
    """(2, n)."""
    feedback: FloatArray
    """(n,)."""
    integral_gain: float
    observer: FloatArray
    """(n, 2)."""
    dt: float
    output_limit: float

    def dynamics(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The controller from y = (rate, angle) to u as a discrete (a, b, c, d), reference 0."""
        n = self.a.shape[0]
        k = self.feedback[None, :]
        correct = np.eye(n) - self.observer @ self.c
        c = np.hstack([-k @ correct, [[-self.integral_gain]]])
        d = -k @ self.observer
        a = np.zeros((n + 1, n + 1))
        b = np.zeros((n + 1, 2))
        a[:n, :n] = self.a @ correct
        a[:n] += self.b @ c
        b[:n] = self.a @ self.observer + self.b @ d
        a[n, n] = 1.0
        b[n, 1] = -self.dt
        return a, b, c, d

    def response(self, omega: FloatArray) -> ComplexArray:
        """(2, f) from the measured rate and angle to u at omega, rad/s."""
        a, b, c, d = self.dynamics()
        z = np.exp(1j * omega * self.dt)
        states = np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, b[None])
        return np.asarray((c @ states + d)[:, 0, :].T)


@dataclass(frozen=True)
class LqrDesign:
    """A controller, its nominal margins, the worst over the ensemble, its square wave."""

    controller: LqrController
    nominal: Margins
    worst: Margins
    """(1,) each, the crossover's highest."""
    square: SquareFigures
    control_weight: float
    """What the control's Bryson weight was multiplied by until the margins held."""


def design_lqr(
    plant: LoopPlant,
    ensemble: Ensemble,
    output_limit: float,
    weights: Weights | None = None,
    noise: Noise | None = None,
    needs: Requirements | None = None,
) -> LqrDesign:
    """The fastest LQR of this family that keeps the margins; DesignRefusedError where none does.

    Curves enter by their describing gains at the wide amplitude.
    """
    needs = needs or Requirements()
    model = state_space(plant, slopes_at(plant, *AMPLITUDES[0]))
    observer = _observer(model, noise or Noise())
    factor = FASTEST
    for _ in range(ROUNDS):
        controller = _controller(model, observer, weights or Weights(), factor, output_limit)
        every = margins(_loop(controller, ensemble), ensemble.omega)
        if meets(every, needs).all() and stable(controller, ensemble):
            return LqrDesign(
                controller=controller,
                nominal=_pick(every, int(np.flatnonzero(ensemble.nominal)[0])),
                worst=_worst(every),
                square=_square(model, controller),
                control_weight=factor,
            )
        factor *= RAISE
    raise DesignRefusedError('no LQR keeps the margins over all draws; identify more precisely')


def stable(controller: LqrController, ensemble: Ensemble) -> bool:
    """Whether the controller stabilises every loop of the ensemble (eigenvalues)."""
    ca, cb, cc, cd = controller.dynamics()
    cycle = ensemble.cycle
    n = cycle.phi.shape[-1]
    depth = int(cycle.whole.max()) + 1
    m = ca.shape[0]
    p = cycle.phi.shape[0]
    matrix = np.zeros((p, n + depth + m, n + depth + m))
    for i in range(p):
        y, d = cycle.c[i], int(cycle.whole[i])
        u = np.zeros((1, n + depth + m))
        u[:, :n] = cd @ y
        u[:, n + depth :] = cc
        matrix[i, :n, :n] = cycle.phi[i]
        matrix[i, :n, n + d] += cycle.before[i]
        if d == 0:
            matrix[i, :n] += cycle.now[i][:, None] @ u
        else:
            matrix[i, :n, n + d - 1] += cycle.now[i]
        matrix[i, n] = u[0]
        matrix[i, n + depth :, :n] = cb @ y
        matrix[i, n + depth :, n + depth :] = ca
    for j in range(1, depth):
        matrix[:, n + j, n + j - 1] = 1.0
    return bool(np.max(np.abs(np.linalg.eigvals(matrix))) < 1.0)


def simulate_lqr(
    model: StateSpace,
    controller: LqrController,
    reference: FloatArray,
    start_angle: float = 0.0,
    push: FloatArray | None = None,
) -> FloatArray:
    """(n,) measured angle, rad, of the linear plant under the controller with its limit.

    `push` is what a torque adds to the plant's states in every cycle; the observer knows nothing
    of it.
    """
    x = np.zeros(model.a.shape[0])
    x[_resting(model)] = start_angle
    guess, total = x.copy(), 0.0
    angles = np.empty(reference.size)
    for k, wanted in enumerate(reference):
        y = model.c @ x
        angles[k] = y[1]
        guess = guess + controller.observer @ (y - controller.c @ guess)
        raw = -float(controller.feedback @ guess) - controller.integral_gain * total
        # the proportional part acts on the error: the angle's feedback pulls to the reference
        raw += _reference_gain(model, controller) * wanted
        u = min(max(raw, -controller.output_limit), controller.output_limit)
        if u == raw:
            total += controller.dt * (wanted - y[1])
        guess = controller.a @ guess + controller.b[:, 0] * u
        x = model.a @ x + model.b[:, 0] * u
        if push is not None:
            x = x + push
    return angles


def _resting(model: StateSpace) -> list[int]:
    """States that hold the angle at rest: the true one and the filtered one."""
    return sorted({TRUE_ANGLE, int(np.argmax(model.c[1]))})


def _reference_gain(model: StateSpace, controller: LqrController) -> float:
    return float(np.sum(controller.feedback[_resting(model)]))


def _controller(
    model: StateSpace, observer: FloatArray, weights: Weights, factor: float, limit: float
) -> LqrController:
    n = model.a.shape[0]
    a = np.zeros((n + 1, n + 1))
    a[:n, :n] = model.a
    a[n, :n] = -model.dt * model.c[1]
    a[n, n] = 1.0
    b = np.vstack([model.b, [[0.0]]])
    q = np.zeros(n + 1)
    # a loop slower by s = factor^(-1/4) keeps its shape when rates count s^-2 and integrals s^2
    q[TRUE_RATE] = np.sqrt(factor) / weights.rate_rad_s**2
    q[TRUE_ANGLE] = 1.0 / weights.angle_rad**2
    q[n] = 1.0 / np.sqrt(factor) / weights.integral_rad_s**2
    gain, _, _ = control.dlqr(a, b, np.diag(q), [[factor / weights.control**2]])
    gain = np.asarray(gain)[0]
    return LqrController(
        model.a, model.b, model.c, gain[:n], float(gain[n]), observer, model.dt, limit
    )


def _observer(model: StateSpace, noise: Noise) -> FloatArray:
    """Stationary Kalman gain (n, 2) of the current estimate, x_hat = x + M (y - C x)."""
    n = model.a.shape[0]
    push = np.zeros((n, 1))
    push[TRUE_RATE] = model.dt
    push[TRUE_ANGLE] = 0.5 * model.dt**2
    measured = np.diag([noise.rate**2, noise.angle**2])
    _, spread, _ = control.dlqe(model.a, push, model.c, [[noise.torque**2]], measured)
    spread = np.asarray(spread)
    return np.asarray(spread @ model.c.T @ np.linalg.inv(model.c @ spread @ model.c.T + measured))


def _loop(controller: LqrController, ensemble: Ensemble) -> ComplexArray:
    """(p, f) loop gain broken at the control, with the sign of negative feedback."""
    return np.asarray(
        -np.einsum('of,opf->pf', controller.response(ensemble.omega), ensemble.response)
    )


def _square(model: StateSpace, controller: LqrController) -> SquareFigures:
    reference = reference_square(model.dt)
    angle = simulate_lqr(model, controller, reference, -float(SQUARE_AMPLITUDE_RAD))
    return square_figures(reference, angle, model.dt)


def _pick(every: Margins, index: int) -> Margins:
    part = slice(index, index + 1)
    return Margins(
        every.phase_margin_deg[part],
        every.gain_margin_db[part],
        every.peak_sensitivity[part],
        every.crossover_rad_s[part],
    )


def _worst(every: Margins) -> Margins:
    return Margins(
        np.min(every.phase_margin_deg, keepdims=True),
        np.min(every.gain_margin_db, keepdims=True),
        np.max(every.peak_sensitivity, keepdims=True),
        np.nanmax(every.crossover_rad_s, keepdims=True),
    )
