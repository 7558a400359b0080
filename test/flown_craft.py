"""A multirotor flown in plain Python: any number of motors, each with its own lag and rotor speed.

It shares no line with the analysis: places and spins are written out here, torques follow from
forces and arms, the controller gives to each motor what its place calls for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

DT, SUBSTEPS = 0.004, 4
X = ((-135, -1), (135, 1), (45, -1), (-45, 1))
"""Motors of the contract's frame: rear left, rear right, front right, front left."""


@dataclass(frozen=True)
class Airframe:
    """Motors by angle clockwise from the nose, degrees, and spin: 1 counter-clockwise."""

    motors: tuple[tuple[float, int], ...]
    lags_s: dict[int, float] = field(default_factory=dict)
    """Lags of single motors, from 0, that differ from `lag_s`."""
    lag_s: float = 0.04
    delay_cycles: int = 2
    push: tuple[float, float, float] = (400.0, 300.0, 60.0)
    """rad/s² of roll, pitch, yaw while the motors of one side stand at 1 and all others at 0."""
    damping: tuple[float, float, float] = (1.0, 1.0, 0.5)
    squared: bool = False
    """Whether thrust follows the square of the speed, else the speed."""
    reaction_s: float = 0.0
    """What the change of the rotors' speeds adds to the yaw torque, s: a true lead."""
    full_rad_s: float = 900.0
    """Speed of a rotor at a command of 1."""
    stops: tuple[int, float, float] | None = None
    """A motor that stands still, from when to when, s."""
    rate_noise: float = 0.004
    torque_noise: float = 0.05
    reach: float = 0.25

    @property
    def places(self) -> np.ndarray:
        """(n, 3) forward, left, and the sense in which a rotor pushes the yaw."""
        return np.array([(math.cos(math.radians(a)), -math.sin(math.radians(a)), -spin)
                         for a, spin in self.motors])


def fly(airframe: Airframe, seed: int, seconds: float = 26.0) -> dict[str, np.ndarray]:
    """Rates and angles (n, 3), motors (n, k) and speeds (n, k), rad/s, in a rate loop.

    All axes are excited, roll most."""
    rng = np.random.default_rng(seed)
    n, k = round(seconds / DT), len(airframe.motors)
    forward, left, turn = airframe.places.T
    weights = np.stack([left / np.abs(left).sum(), -forward / np.abs(forward).sum(),
                        turn / np.abs(turn).sum()])
    spread = np.stack([left / np.abs(left).max(), -forward / np.abs(forward).max(), turn], axis=1)
    lags = np.array([airframe.lags_s.get(i, airframe.lag_s) for i in range(k)])
    h = DT / SUBSTEPS
    keep = np.exp(-h / lags)
    wanted = np.zeros((n, 3))
    for axis, (size, held) in enumerate(((1.0, 12), (0.5, 40), (0.3, 90))):
        steps = rng.choice([-1.0, -0.4, 0.4, 1.0], n // held + 1)
        wanted[:, axis] = np.repeat(size * steps, held)[:n]
    rates, motors, speeds = np.zeros((n, 3)), np.zeros((n, k)), np.zeros((n, k))
    rate, speed, kp = np.zeros(3), np.full(k, 0.5), np.array([0.05, 0.05, 0.1])
    angle, angles = np.zeros(3), np.zeros((n, 3))
    for i in range(n):
        angles[i] = angle
        rates[i] = rate + airframe.rate_noise * rng.standard_normal(3)
        speeds[i] = airframe.full_rad_s * speed + 0.5 * rng.standard_normal(k)
        reference = airframe.reach * 8.0 * wanted[i] - 2.0 * angle
        command = np.clip(kp * (reference - rates[i]), -0.15, 0.15)
        throttle = 0.5 + 0.03 * math.sin(1.7 * i * DT)
        motors[i] = np.clip(throttle + spread @ command, 0.0, 1.0)
        sent = motors[max(0, i - airframe.delay_cycles)].copy()
        if airframe.stops is not None and airframe.stops[1] <= i * DT < airframe.stops[2]:
            sent[airframe.stops[0]] = 0.0
        gust = airframe.torque_noise / math.sqrt(DT) * rng.standard_normal(3)
        for _ in range(SUBSTEPS):
            middle = sent + (speed - sent) * np.sqrt(keep)
            thrust = middle**2 if airframe.squared else middle
            torque = np.array(airframe.push) * (weights @ thrust) + gust
            change = weights[2] @ ((sent - middle) / lags)
            torque[2] += airframe.push[2] * airframe.reaction_s * change
            rate = rate + h * (torque - np.array(airframe.damping) * rate)
            angle = angle + h * rate
            speed = sent + (speed - sent) * keep
    return {'rates': rates, 'angles': angles, 'motors': motors, 'speeds': speeds}
