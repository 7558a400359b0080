"""What a grey-box structure is: the base's parameters and the effects added to it.

The table of effects stands in quad_sysid.effects; nothing is simulated here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import AxisData

Settings = Mapping[str, float | str | tuple[float, ...] | tuple[str, ...]]


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter: unit, bounds, and values to start the fit from."""

    name: str
    unit: str
    lower: float
    upper: float
    starts: tuple[float, ...]
    scale: float
    """A typical size: the fit's first scaling, and what counts as a small change."""


BASE_PARAMETERS = (
    ParameterSpec('gain', 'rad/s² per unit command', -np.inf, np.inf, (), 100.0),
    ParameterSpec('lag', 's', 0.0, 1.0, (0.03, 0.1), 0.03),
    ParameterSpec('delay', 's', 0.0, 0.1, (0.004, 0.016), 0.008),
    ParameterSpec('damping', '1/s', -5.0, 100.0, (0.5,), 0.5),
    ParameterSpec('bias', 'rad/s²', -np.inf, np.inf, (0.0,), 0.5),
)
"""The contract's base: rate' = gain (command behind delay and lag) - damping rate + bias."""


@dataclass(frozen=True)
class Term:
    """A feedback or known torque for the compiled loop: its code, numbers and signal (n,)."""

    code: int
    values: tuple[float, ...]
    signal: FloatArray | None = None


CommandMap = Callable[[AxisData, FloatArray, FloatArray, Settings, FloatArray], FloatArray]
"""(data, command (n,), parameters (p,), settings, base's parameters (5,)) -> command (n,)."""


@dataclass(frozen=True)
class Effect:
    """A physical effect that the base lacks. One entry of effects/table.py.

    It acts on the command before delay and lag (`command`), or adds a torque (`torque`), or both.
    Both get the parameters (p,) in the order of `parameters` and the settings of `prepare`;
    `command` gets the base's parameters as well.
    """

    name: str
    signals: tuple[str, ...]
    parameters: tuple[ParameterSpec, ...]
    physics: str
    """The equation, with units, and its source."""
    excite: str
    """Which test flight would show it."""
    kind: str = 'named'
    prepare: Callable[[AxisData], Settings | str] | None = None
    """Settings from the training data, or in words why it cannot be tested on them."""
    command: CommandMap | None = None
    torque: Callable[[AxisData, FloatArray, Settings], Term] | None = None
    variant: str = ''
    """Tells entries of one name apart, such as the other axis that couples in."""
    starts: Callable[..., tuple[tuple[float, ...], ...]] | None = None
    """(simulator, fit without it, itself) -> values to start from; None: those of the specs."""
    prior: Callable[[Settings], FloatArray] | None = None
    """(r, p) rows whose product with the parameters is of size 1 beforehand; None: no prior."""


Prepared = tuple[Effect, Settings]
"""An effect with the settings that the training data gave it."""


def equilibrium(base: FloatArray) -> tuple[float, float]:
    """Command and rate (rad/s) at which a base rests whose parameters (5, or more) these are."""
    gain, bias = float(base[0]), float(base[4])
    return (-bias / gain if gain else 0.0), 0.0


@dataclass(frozen=True)
class Structure:
    """The base and the effects on top, with the settings each effect was prepared with."""

    effects: tuple[Effect, ...] = ()
    settings: tuple[Settings, ...] = field(default=())

    @property
    def specs(self) -> tuple[ParameterSpec, ...]:
        """All parameters in the order of the vector: base first, then effect by effect."""
        return BASE_PARAMETERS + tuple(p for e in self.effects for p in e.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """`gain`, …, then `<effect>.<parameter>`."""
        return tuple(p.name for p in BASE_PARAMETERS) + tuple(
            f'{e.name}.{p.name}' for e in self.effects for p in e.parameters
        )

    def slices(self) -> list[slice]:
        """Where each effect's parameters stand in the vector."""
        out: list[slice] = []
        position = len(BASE_PARAMETERS)
        for effect in self.effects:
            out.append(slice(position, position + len(effect.parameters)))
            position += len(effect.parameters)
        return out

    def prior(self) -> FloatArray:
        """(r, p) rows of all effects' priors over the whole parameter vector."""
        p = len(self.specs)
        blocks = [np.zeros((0, p))]
        for effect, settings, where in zip(
            self.effects, self.settings, self.slices(), strict=True
        ):
            if effect.prior is not None:
                rows = effect.prior(settings)
                block = np.zeros((rows.shape[0], p))
                block[:, where] = rows
                blocks.append(block)
        return np.vstack(blocks)

    def with_effect(self, effect: Effect, settings: Settings) -> Structure:
        """This structure with one more effect."""
        return Structure((*self.effects, effect), (*self.settings, settings))

    def without(self, name: str) -> Structure:
        """This structure less one effect."""
        keep = [i for i, e in enumerate(self.effects) if e.name != name]
        return Structure(
            tuple(self.effects[i] for i in keep), tuple(self.settings[i] for i in keep)
        )
