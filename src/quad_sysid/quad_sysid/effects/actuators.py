"""Effects between command and torque: maps of the command, motors, voltage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import MIXER_INVERSE, FloatArray
from quad_sysid.effects.couplings import over_training
from quad_sysid.model import recursion
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Drive, Dynamics, Effect, Settings, Signals, Spec, required

MOVES = 0.02
"""Share of its mean by which a signal must move for its effect to show."""
LIGHT = 0.3
"""Damping ratio up to which a mode counts as lightly damped."""


def along(
    data: AxisData, signal: FloatArray, kernel: Callable[..., None], *numbers: float
) -> FloatArray:
    """(n,) a compiled kernel with memory, run along each unbroken stretch of a signal (n,)."""
    out = np.array(signal, dtype=float)
    for start, stop in data.stretches:
        kernel(signal, *numbers, start, stop, out)
    return out


class DeadZone(Effect):
    """Small commands have no effect."""

    name = 'dead_zone'
    signals = ('command',)
    term = 'command'
    parameters = (
        Spec('half_width', '1', spread=2.0, centre=math.log(0.003), log=True,
             starts=(0.0003, 0.001, 0.003, 0.01)),
    )
    physics = 'sign(u) max(|u| - w, 0): the motors do not answer to small commands'
    excite = 'small commands around zero: a multisine of small amplitude'

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return np.sign(command) * np.maximum(np.abs(command) - p[0], 0.0)


class Backlash(Effect):
    """Play between the command and the torque."""

    name = 'backlash'
    signals = ('command', 'history')
    term = 'command'
    parameters = (
        Spec('half_width', '1', spread=2.0, centre=math.log(0.003), log=True,
             starts=(0.0003, 0.001, 0.003, 0.01)),
    )
    physics = 'play of +-w between command and torque'
    excite = 'small slow reversals of the command'

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return along(data, command, recursion.play, float(p[0]))


class BatterySag(Effect):
    """The gain follows a power of the battery's voltage."""

    name = 'battery_sag'
    signals = ('battery', 'command')
    term = 'gain'
    parameters = (Spec('exponent', '1', spread=1.5),)
    physics = 'gain (V / V_ref)^n: thrust per command falls with the pack voltage'
    excite = 'a long flight, or throttle changes, so that the voltage moves by 5 % or more'

    def prepare(self, data: AxisData) -> Settings | str:
        if data.battery_v is None:
            return 'the bag holds no battery voltage'
        used = over_training(data, data.battery_v)
        if np.ptp(used) < 0.002 * np.mean(used):
            return f'the voltage moves by {np.ptp(used):.3f} V only; fly longer'
        return {'reference_v': float(np.mean(used))}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return s.drive * ((required(s.battery_v) / float(settings['reference_v'])) ** p[0] - 1.0)

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        return {'battery': float(settings['reference_v'])}


class ThrustCurve(Effect):
    """The thrust of each propeller is quadratic in its motor command."""

    name = 'thrust_curve'
    signals = ('command', 'throttle')
    term = 'command'
    parameters = (Spec('curvature', '1', spread=0.4),)
    physics = 'thrust (1 - k) m + k m² of each motor command m'
    excite = 'throttle changes during the excitation, or large commands on two axes at once'

    def prepare(self, data: AxisData) -> Settings | str:
        throttle = over_training(data, data.control[:, 0])
        others = [over_training(data, data.control[:, i + 1]) for i in range(3) if i != data.index]
        mean = float(np.mean(throttle))
        product = float(np.std(others[0] * others[1]))
        command = float(np.std(over_training(data, data.command)))
        if np.std(throttle) < MOVES * mean and product < MOVES * command:
            return f'the throttle stays at {mean:.2f}; fly with throttle changes'
        return {'throttle': mean}

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        # the lag is the motor's, the curve its propeller's: v = (1 - k) m + k m² of the lagged m
        # follows the same lag where the command is (1 - k) u + k (2 u m - m²)
        k, tau = p[0], float(drive.lag[0, 0])
        u = data.motors.T
        m = np.stack([
            along(data, np.ascontiguousarray(one), recursion.first_order, tau, data.dt)
            for one in u
        ])
        slope = max(1.0 - k + 2.0 * k * float(settings['throttle']), 1e-3)
        row = MIXER_INVERSE[data.index + 1]
        bent = (row @ (k * (2.0 * u * m - m * m - u)) + drive.commands[0]) / slope
        return replace(drive, commands=np.vstack([bent, drive.commands[1:]]))

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        return {'throttle': float(settings['throttle'])}


class Motors(Effect):
    """A map of the motors' commands (4, n), which subclasses give."""

    term = 'command'

    def map(
        self, data: AxisData, motors: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        """(4, n) commands after the effect."""
        raise NotImplementedError

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        m = data.motors.T
        lost = self.map(data, m, p, settings) - m
        return command + MIXER_INVERSE[data.index + 1] @ lost


class Saturation(Motors):
    """Each motor command is limited on one side."""

    name = 'saturation'
    signals = ('command', 'motors')
    physics = 'clip(m, lower, upper): the motors stop short of what is commanded'
    excite = 'large commands: a square wave of large amplitude'

    def __init__(self, side: str) -> None:
        self.variant = side
        self.parameters = (Spec(side, '1', spread=0.3, centre=1.0 if side == 'upper' else 0.0),)

    def prepare(self, data: AxisData) -> Settings | str:
        motors = over_training(data, data.motors)
        if np.ptp(motors) < 1e-6:
            return 'the bag holds no motor commands'
        return {'lowest': float(motors.min()), 'highest': float(motors.max())}

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        motors = over_training(data, data.motors)
        shares = (99.0, 95.0, 85.0) if self.variant == 'upper' else (1.0, 5.0, 15.0)
        return [np.array([value]) for value in np.percentile(motors, shares)]

    def map(
        self, data: AxisData, motors: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return np.minimum(motors, p[0]) if self.variant == 'upper' else np.maximum(motors, p[0])

    def readable(self, p: FloatArray, settings: Settings) -> dict[str, tuple[float, str]]:
        upper = self.variant == 'upper'
        return {
            'lower': (0.0 if upper else float(p[0]), '1'),
            'upper': (float(p[0]) if upper else 1.0, '1'),
        }

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        return np.array([values[self.variant]])

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        # in the middle of the motors' limits: as far to either side
        return {'throttle': 0.5 * float(p[0] + (0.0 if self.variant == 'upper' else 1.0))}


class SlewLimit(Motors):
    """The rate of change of each motor command is limited."""

    name = 'shape:lag:command'
    kind = 'shape'
    variant = 'slew limit'
    signals = ('command', 'motors', 'history')
    term = 'response'
    parameters = (
        Spec('slew', '1/s', spread=1.5, centre=math.log(3.0), log=True,
             starts=(0.5, 1.5, 4.0, 10.0)),
    )
    physics = 'the command of a motor changes by at most so much a second'
    excite = 'large steps of the command'

    def map(
        self, data: AxisData, motors: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        step = float(p[0]) * data.dt
        return np.stack([
            along(data, np.ascontiguousarray(m), recursion.slew, step) for m in motors
        ])


class Steps(Motors):
    """Each motor command is quantised."""

    name = 'shape:gain:command'
    kind = 'shape'
    variant = 'steps'
    signals = ('command', 'motors')
    parameters = (
        Spec('step', '1', spread=1.5, centre=math.log(0.01), log=True,
             starts=tuple(np.geomspace(0.002, 0.06, 15))),
    )
    physics = 'motors take their command in whole steps'
    excite = 'slow small commands'

    def map(
        self, data: AxisData, motors: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return np.round(motors / p[0]) * p[0]


class SlowShare(Effect):
    """A share of the axis' torque has a longer lag."""

    name = 'motor_lag'
    signals = ('command',)
    term = 'response'
    parameters = (
        Spec('slow_time_constant', 's', spread=0.7, centre=math.log(0.12), log=True,
             starts=(0.09, 0.15, 0.3)),
        Spec('share', '1', spread=0.3),
    )
    physics = 'a share of the motors answers with a longer lag than the others'
    excite = 'a PRBS that reaches beyond 1 / lag'

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        slow = np.broadcast_to(np.maximum(p[0], drive.lag[:1]), drive.lag[:1].shape)
        return replace(
            drive,
            commands=np.vstack([drive.commands, drive.commands[:1]]),
            row=np.r_[drive.row[:1] * (1.0 - p[1]), drive.row[1:], drive.row[:1] * p[1]],
            lag=np.vstack([drive.lag, slow]),
        )


def by_motor(data: AxisData, drive: Drive) -> Drive:
    """One channel for each motor, and one for what earlier effects added to the command."""
    row = MIXER_INVERSE[data.index + 1]
    rest = drive.commands[:1] - (row @ data.motors.T)[None, :]
    return replace(
        drive, commands=np.vstack([data.motors.T, rest, drive.commands[1:]]),
        row=np.r_[row * drive.row[0], drive.row],
        lag=np.vstack([np.repeat(drive.lag[:1], 4, axis=0), drive.lag]),
    )


class SlowMotor(Effect):
    """One motor has a longer lag than the others."""

    name = 'motor_lag'
    signals = ('command', 'motors')
    term = 'response'
    parameters = (
        Spec('slow_time_constant', 's', spread=0.7, centre=math.log(0.12), log=True,
             starts=(0.07, 0.12, 0.25)),
    )
    physics = 'one motor answers with a longer lag; the other axes then act here as well'
    excite = 'hover with all axes moving'

    def __init__(self, motor: int) -> None:
        self.motor = motor
        self.variant = f'motor {motor + 1}'

    def prepare(self, data: AxisData) -> Settings | str:
        own = over_training(data, data.command)
        moving = [
            np.std(over_training(data, data.control[:, i + 1])) > 0.05 * np.std(own)
            for i in range(3) if i != data.index
        ]
        if np.ptp(over_training(data, data.motors)) < 1e-6 or not any(moving):
            return 'the other axes hardly move, so no single motor can be told apart'
        return {}

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        split = by_motor(data, drive)
        lag = split.lag.copy()
        lag[self.motor] = p[0]
        return replace(split, lag=lag)


class AsymmetricLag(Effect):
    """The lag differs between acceleration and deceleration of a motor."""

    name = 'shape:lag:direction'
    kind = 'shape'
    signals = ('command', 'direction')
    term = 'response'
    parameters = (Spec('asymmetry', '1', spread=0.5),)
    physics = 'a motor slows down with the lag times exp(a) and speeds up with the lag over exp(a)'
    excite = 'steps of the command up and down'

    def __init__(self, variant: str) -> None:
        self.variant = variant

    def prepare(self, data: AxisData) -> Settings | str:
        if self.variant == 'motors' and np.ptp(over_training(data, data.motors)) < 1e-6:
            return 'the bag holds no motor commands'
        return {}

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        split = by_motor(data, drive) if self.variant == 'motors' else drive
        return replace(split, asymmetry=split.asymmetry + float(p[0]))


class SecondLag(Effect):
    """A second first-order lag in series with the motors."""

    name = 'mode'
    kind = 'mode'
    variant = 'second lag'
    signals = ('command', 'history')
    term = 'response'
    parameters = (
        Spec('time_constant', 's', spread=1.0, centre=math.log(0.02), log=True,
             starts=(0.01, 0.03, 0.1)),
    )
    physics = 'a second first-order lag between command and torque'
    excite = 'a PRBS that reaches beyond 1 / lag'

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return along(data, command, recursion.first_order, max(float(p[0]), 1e-5), data.dt)

    def dynamics(self, p: FloatArray) -> Dynamics | None:
        return Dynamics(lag_s=float(p[0]))


class Resonance(Effect):
    """A lightly damped mode in parallel with the command."""

    name = 'resonance'
    signals = ('command', 'history')
    term = 'response'
    parameters = (
        Spec('frequency', 'Hz', spread=0.8, centre=math.log(5.0), log=True,
             starts=tuple(np.geomspace(1.5, 16.0, 12))),
        Spec('damping_ratio', '1', spread=0.7, centre=math.log(0.06), log=True, starts=(0.06,)),
        # at its peak a mode adds half of what is commanded: share / (2 damping ratio)
        Spec('in_phase', '1', spread=0.06),
        Spec('quadrature', '1', spread=0.06),
    )
    physics = "z'' + 2 d w z' + w² z = w² u; adds in_phase z + quadrature z'/w to the command"
    excite = 'a chirp or PRBS through the mode'

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return along(
            data, command, recursion.light_mode, 2.0 * math.pi * min(float(p[0]), 0.4 / data.dt),
            min(float(p[1]), LIGHT), float(p[2]), float(p[3]), data.dt,
        )

    def dynamics(self, p: FloatArray) -> Dynamics | None:
        return Dynamics(
            0.0, 2.0 * math.pi * float(p[0]), min(float(p[1]), LIGHT), float(p[2]), float(p[3])
        )


ACTUATORS = (
    DeadZone(), Backlash(), BatterySag(), ThrustCurve(), Saturation('upper'), Saturation('lower'),
    SlowShare(), *(SlowMotor(i) for i in range(4)), AsymmetricLag('motors'), AsymmetricLag('axis'),
    SlewLimit(), Steps(), SecondLag(), Resonance(),
)
