"""The effects that act on the command, as stages of the compiled closed loop.

The table of effects maps whole arrays; in a loop the command is known only up to now. A map that
is a known factor and a known addition, or a curve of the command, is taken from the effect's own
map; those with a memory and the motors' limits are written out (one entry each in STAGES).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import MIXER, MIXER_INVERSE, FloatArray
from quad_sysid.effects import commands
from quad_sysid.effects.commands import held_step
from quad_sysid.effects.curves import basis, knot_positions
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.simulate import N_BASE
from quad_sysid.greybox.structure import CommandMap, Effect, Settings, Structure
from quad_sysid.separation import kernels

HALF_RANGE = 0.5
"""Commands that a table of the command covers; outside its end slopes go on."""
TABLE_POINTS = 20001


@dataclass(frozen=True)
class Stage:
    """One map of the command: code, values (q,) and signals (s, n) as kernels.fly takes them."""

    code: int
    values: tuple[float, ...] = ()
    signals: FloatArray | None = None


Maker = Callable[[Effect, AxisData, FloatArray, Settings, FloatArray], Stage]


def _affine(
    effect: Effect, data: AxisData, p: FloatArray, settings: Settings, base: FloatArray
) -> Stage:
    """A known factor and a known addition, read off the map at the commands 0 and 1."""
    if effect.command is None:
        return Stage(kernels.AFFINE, (), np.stack([np.ones(data.rate.size), data.rate * 0.0]))
    zero, one = (
        effect.command(data, np.full(data.rate.size, u), p, settings, base) for u in (0.0, 1.0)
    )
    return Stage(kernels.AFFINE, (), np.stack([one - zero, zero]))


def _table(
    effect: Effect, data: AxisData, p: FloatArray, settings: Settings, base: FloatArray
) -> Stage:
    """A curve of the command alone."""
    u = np.linspace(-HALF_RANGE, HALF_RANGE, TABLE_POINTS)
    y = u if effect.command is None else effect.command(data, u, p, settings, base)
    return Stage(kernels.TABLE, (-HALF_RANGE, float(u[1] - u[0]), float(u.size), *y.tolist()))


def _thrust(
    _: Effect, data: AxisData, p: FloatArray, settings: Settings, base: FloatArray
) -> Stage:
    """A curve of what the motors give behind their lag (commands.behind_lag)."""
    x, y = knot_positions(settings), basis(settings) @ p
    decay, mean, _ratio = _lag(float(base[1]), data.dt, base)
    return Stage(kernels.THRUST, (decay, mean, float(x.size), *x.tolist(), *y.tolist()))


def _limits(
    _: Effect, data: AxisData, p: FloatArray, __: Settings, ___: FloatArray
) -> Stage:
    """Limits of each motor; its signals are the motors without this axis' command."""
    signs = MIXER[:, data.index + 1].tolist()
    return Stage(kernels.LIMITS, (float(p[0]), float(p[1]), *signs), _others(data))


def _others(data: AxisData) -> FloatArray:
    """(4, n) motor commands less what this axis asks of them."""
    control = data.control.copy()
    control[:, data.index + 1] = 0.0
    out: FloatArray = np.ascontiguousarray((control @ MIXER.T).T)
    return out


def _play(_: Effect, __: AxisData, p: FloatArray, ___: Settings, ____: FloatArray) -> Stage:
    return Stage(kernels.PLAY, (float(p[0]),))


def _slow(_: Effect, data: AxisData, p: FloatArray, __: Settings, base: FloatArray) -> Stage:
    """A share of the command behind a longer lag."""
    decay, mean, ratio = _lag(float(p[0]), data.dt, base)
    return Stage(kernels.SLOW, (decay, mean, float(p[1]), ratio))


def _slow_motor(
    _: Effect, data: AxisData, p: FloatArray, settings: Settings, base: FloatArray
) -> Stage:
    """The same of one motor, which other axes move as well."""
    number = settings['motor']
    motor = int(number) if isinstance(number, float) else 0
    decay, mean, ratio = _lag(float(p[0]), data.dt, base)
    share = float(MIXER_INVERSE[data.index + 1, motor])
    sign = float(MIXER[motor, data.index + 1])
    return Stage(
        kernels.SLOW_MOTOR, (decay, mean, share, ratio, sign), _others(data)[motor : motor + 1]
    )


def _lag(slow_s: float, dt: float, base: FloatArray) -> tuple[float, float, float]:
    """Decay of a lag over a cycle, its mean over it, and the base's lag over it."""
    slow = max(slow_s, 1e-3)
    decay = math.exp(-dt / slow)
    return decay, slow / dt * (1.0 - decay), float(base[1]) / slow


def _mode(_: Effect, data: AxisData, p: FloatArray, __: Settings, ___: FloatArray) -> Stage:
    omega, damping = 2.0 * math.pi * float(p[0]), float(p[1])
    a = np.array([[0.0, 1.0], [-(omega**2), -2.0 * damping * omega]])
    parts = [held_step(a, np.array([0.0, omega**2]), h) for h in (data.dt, 0.5 * data.dt)]
    values = np.concatenate([x.ravel() for part in parts for x in part])
    return Stage(kernels.MODE, (*values.tolist(), float(p[2]), float(p[3]) / omega))


STAGES: Mapping[CommandMap, Maker] = {
    commands.dead_zone: _table, commands.saturation: _limits, commands.backlash: _play,
    commands.slow_motors: _slow, commands.one_slow_motor: _slow_motor, commands.resonance: _mode,
}
"""Maps that are no known factor and addition."""


def _maker(effect: Effect) -> Maker:
    if effect.name == 'shape:command':
        return _thrust if effect.variant == 'thrust' else _table
    return _affine if effect.command is None else STAGES.get(effect.command, _affine)


Stages = tuple[np.ndarray, FloatArray, FloatArray]


def stages_of(structure: Structure, theta: FloatArray, data: AxisData) -> Stages:
    """Codes (m,), values (m, q) and signals (m, s, n) of all effects on the command, in order.

    `data` gives the signals that are known before the flight: throttle, other axes, battery.
    """
    made = [
        _maker(effect)(effect, data, theta[where], settings, theta[:N_BASE])
        for effect, settings, where in zip(
            structure.effects, structure.settings, structure.slices(), strict=True
        )
        if effect.command is not None
    ]
    return packed(made, data.rate.size)


def packed(made: Sequence[Stage], n: int) -> Stages:
    """Stages of unlike sizes as three arrays."""
    width = max((len(s.values) for s in made), default=1)
    values = np.zeros((len(made), max(width, 1)))
    signals = np.zeros((len(made), 4 if made else 0, n))
    for i, stage in enumerate(made):
        values[i, : len(stage.values)] = stage.values
        if stage.signals is not None:
            signals[i, : stage.signals.shape[0]] = stage.signals
    return np.array([s.code for s in made], dtype=np.int64), values, signals
