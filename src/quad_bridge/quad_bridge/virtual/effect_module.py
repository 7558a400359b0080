"""Loads a user's effect from a Python file: `effect(t_s, rates, angles, thrusts, battery_v)`.

Called before every physics step with scalars in s and V and arrays of 3 (rad/s), 3 (rad), 4 (N);
returns an extra body torque (3,) in N m, held over the step. Whatever goes wrong in the file comes
out as one ConfigurationError that names it.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.aircraft import EffectFunction
from quad_bridge.virtual.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]


def load_effect(path: Path) -> EffectFunction:
    """The checked function `effect` of the file; raises ConfigurationError."""
    spec = importlib.util.spec_from_file_location('virtual_stm32_effect', path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ConfigurationError(str(path), 'is not a readable Python file (.py)')
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(str(path), f'cannot be loaded: {_named(error)}') from error
    function = getattr(module, 'effect', None)
    if not callable(function):
        raise ConfigurationError(
            str(path), 'has no function effect(t_s, rates, angles, thrusts, battery_v)'
        )
    return checked(function, str(path))


def checked(function: EffectFunction, name: str) -> EffectFunction:
    """`function` with its result held to three finite numbers; errors name `name`."""

    def effect(
        t_s: float, rates: FloatArray, angles: FloatArray, thrusts: FloatArray, battery_v: float
    ) -> FloatArray:
        try:
            returned = function(t_s, rates, angles, thrusts, battery_v)
            torque = np.array(returned, dtype=np.float64)
        except (Exception, SystemExit) as error:
            raise ConfigurationError(
                name, f'effect() at t = {t_s:.3f} s: {_named(error)}'
            ) from error
        if torque.shape != (3,) or not np.isfinite(torque).all():
            raise ConfigurationError(
                name,
                f'effect() at t = {t_s:.3f} s must return three finite torques in N m, '
                f'returned {str(returned)[:80]}',
            )
        return torque

    return effect


def _named(error: BaseException) -> str:
    return f'{type(error).__name__}: {error}'
