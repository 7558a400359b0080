"""A multirotor flown in plain Python: any number of motors, each with its own lag and rotor speed.

It shares no line with the analysis: places and spins are written out here, torques follow from
forces and arms, the controller gives to each motor what its place calls for.
"""

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
    reaction = airframe.push[2] * airframe.reaction_s * turn / np.abs(turn).sum()
    push, damping = np.array(airframe.push), np.array(airframe.damping)
    # a cycle at once: motors at the middle of each substep, and rates at its end by all torques
    h, step = DT / SUBSTEPS, np.arange(SUBSTEPS)[:, None]
    middles, keep = np.exp(-h * (step + 0.5) / lags), np.exp(-DT / lags)
    fall, since = 1.0 - h * damping, (step - step.T)[:, :, None]
    falls = fall ** (step + 1)
    passed_on = np.where(since < 0, 0.0, h * fall ** np.maximum(since, 0))
    wanted = np.zeros((n, 3))
    for axis, (size, held) in enumerate(((1.0, 12), (0.5, 40), (0.3, 90))):
        steps = rng.choice([-1.0, -0.4, 0.4, 1.0], n // held + 1)
        wanted[:, axis] = np.repeat(size * steps, held)[:n]
    noise = rng.standard_normal((n, 6 + k))
    gusts = airframe.torque_noise / math.sqrt(DT) * noise[:, 3 + k :]
    rates, angles, speeds = airframe.rate_noise * noise[:, :3], np.zeros((n, 3)), np.zeros((n, k))
    motors, throttle = np.zeros((n, k)), 0.5 + 0.03 * np.sin(1.7 * DT * np.arange(n))
    rate, angle, speed, kp = np.zeros(3), np.zeros(3), np.full(k, 0.5), np.array([0.05, 0.05, 0.1])
    for i in range(n):
        angles[i], speeds[i] = angle, speed
        rates[i] += rate
        reference = airframe.reach * 8.0 * wanted[i] - 2.0 * angle
        command = (kp * (reference - rates[i])).clip(-0.15, 0.15)
        motors[i] = (throttle[i] + spread @ command).clip(0.0, 1.0)
        sent = motors[max(0, i - airframe.delay_cycles)]
        if airframe.stops is not None and airframe.stops[1] <= i * DT < airframe.stops[2]:
            sent = np.where(np.arange(k) == airframe.stops[0], 0.0, sent)
        middle = sent + (speed - sent) * middles
        torque = push * ((middle**2 if airframe.squared else middle) @ weights.T) + gusts[i]
        torque[:, 2] += ((sent - middle) / lags) @ reaction
        path = falls * rate + (passed_on * torque).sum(axis=1)
        rate, angle = path[-1], angle + h * path.sum(axis=0)
        speed = sent + (speed - sent) * keep
    speeds = airframe.full_rad_s * speeds + 0.5 * noise[:, 3 : 3 + k]
    return {'rates': rates, 'angles': angles, 'motors': motors, 'speeds': speeds}
