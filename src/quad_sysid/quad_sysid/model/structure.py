"""The parameters of a base, its effects and its noise, in the order of one vector."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray
from quad_sysid.model.effect import Part, Spec

LARGEST_LOG = 40.0
"""Bound of a logarithm, which a step of the search may exceed: no overflow."""
BASE = (
    Spec('gain', 'rad/s² per unit command'),
    Spec('lag', 's', spread=1.2, centre=math.log(0.04), log=True, starts=(0.04,)),
    Spec('delay', 's', spread=1.2, centre=math.log(0.01), log=True, starts=(0.01,)),
    Spec('damping', '1/s'),
    Spec('bias', 'rad/s²'),
)
NOISE = (
    Spec('white', '(rad/s²)/√Hz per rad/s', spread=3.0, centre=math.log(10.0), log=True),
    Spec('disturbance', 'rad/s² per rad/s', spread=3.0, centre=math.log(30.0), log=True),
    Spec('correlation', 's', spread=1.0, centre=math.log(0.3), log=True),
    Spec('after', '1', spread=1.0, centre=math.log(0.1), log=True),
)
SHARED = Spec('shared', '1', spread=1.0)
"""Share of another axis' disturbance that disturbs this one too, as gusts at an angle do."""
LINE = (
    Spec('line', '1', spread=2.0, centre=0.0, log=True),
    Spec('line_frequency', 'Hz', spread=2.0, centre=math.log(50.0), log=True),
    Spec('line_width', 'Hz', spread=1.5, centre=math.log(1.0), log=True),
)
"""A line in the gyro's noise: vibration, or slow noise where it is wider than its frequency."""


@dataclass(frozen=True)
class Structure:
    """The base and its effects, each with its settings, and the parts of the noise."""

    parts: tuple[Part, ...] = ()
    lines: int = 0
    """Number of lines in the gyro's noise."""
    averaged: bool = False
    """Whether the gyro's noise, before its filter, is averaged over two cycles. So it is where the
    filter is computed once a cycle by the bilinear transformation (Oppenheim, Schafer, 7.1)."""
    shared: tuple[int, ...] = ()
    """The other axes (0, 1) that share their disturbance with this one."""
    law: Part | None = None
    """A law of the user's that the base has beside its built-in terms (own_base.py)."""

    @property
    def base(self) -> tuple[Spec, ...]:
        """The base's parameters: the first ones of the vector."""
        return BASE if self.law is None else BASE + self.law.effect.parameters

    @cached_property
    def noise(self) -> tuple[Spec, ...]:
        """The noise's parameters: the last ones of the vector."""
        return (SHARED,) * len(self.shared) + NOISE + LINE * self.lines

    @cached_property
    def filtered(self) -> int:
        """Number of noise parameters that shape the filter: the last ones of the vector."""
        return len(NOISE) + len(LINE) * self.lines

    @cached_property
    def specs(self) -> tuple[Spec, ...]:
        """Specs in the order of the vector: base, effect by effect, noise."""
        of_effects = tuple(s for part in self.parts for s in part.effect.parameters)
        return self.base + of_effects + self.noise

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in that order: `gain`, …, `<effect>.<parameter>`, the noise."""
        return (
            self.base_names
            + tuple(f'{p.effect.name}.{s.name}' for p in self.parts for s in p.effect.parameters)
            + tuple(f'noise.{s.name}' for s in self.noise)
        )

    @cached_property
    def base_names(self) -> tuple[str, ...]:
        """Names of the base's parameters; a law's begin with its own, as an effect's do."""
        built_in = tuple(s.name for s in BASE)
        law = None if self.law is None else self.law.effect
        return built_in + (tuple(f'{law.name}.{s.name}' for s in law.parameters) if law else ())

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Labels of the effects."""
        return tuple(part.effect.label for part in self.parts)

    @cached_property
    def states(self) -> int:
        """Number of the filter's states: four, two of each line, one of each wandering effect."""
        return 4 + 2 * self.lines + sum(part.effect.wanders for part in self.parts)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Each effect's slice of the vector."""
        counts = (len(part.effect.parameters) for part in self.parts)
        stops = itertools.accumulate(counts, initial=len(self.base))
        return tuple(slice(begin, end) for begin, end in itertools.pairwise(stops))

    @cached_property
    def effects(self) -> tuple[tuple[Part, slice], ...]:
        """Each effect with its slice of the vector."""
        return tuple(zip(self.parts, self.slices, strict=True))

    @cached_property
    def placed(self) -> tuple[tuple[Part, slice], ...]:
        """The law, if any, and the effects, each with its slice of the vector."""
        law = () if self.law is None else ((self.law, slice(len(BASE), len(self.base))),)
        return law + self.effects

    @cached_property
    def command_effects(self) -> tuple[tuple[Part, slice], ...]:
        """The effects that act before the torque."""
        return tuple(acting for acting in self.placed if acting[0].effect.moves_command)

    @cached_property
    def torque_effects(self) -> tuple[tuple[Part, slice], ...]:
        """The effects that add a torque."""
        return tuple(acting for acting in self.placed if not acting[0].effect.moves_command)

    @cached_property
    def logs(self) -> NDArray[np.bool_]:
        """(p,) which coordinates of the fit are logarithms."""
        return logs_of(self.specs)

    def plus(self, part: Part) -> Structure:
        """The structure with one more effect."""
        return replace(self, parts=(*self.parts, part))

    def minus(self, *indices: int) -> Structure:
        """The structure without the effects with these indices."""
        remaining = (part for i, part in enumerate(self.parts) if i not in indices)
        return replace(self, parts=tuple(remaining))

    def natural(self, theta: FloatArray) -> FloatArray:
        """(p,) parameters in their units from the coordinates of the fit, theta (p,)."""
        return natural(self.logs, theta)


def logs_of(specs: Sequence[Spec]) -> NDArray[np.bool_]:
    """(p,) which coordinates of the fit are logarithms."""
    return np.array([s.log for s in specs])


def natural(logs: NDArray[np.bool_], theta: FloatArray) -> FloatArray:
    """(p,) parameters in their units from coordinates of the fit, those in `logs` logarithms."""
    return np.where(logs, np.exp(theta.clip(-LARGEST_LOG, LARGEST_LOG)), theta)


def coordinates(specs: Sequence[Spec], values: FloatArray, least: float = 1e-12) -> FloatArray:
    """The inverse of `natural`; a logarithm is of `least` at least."""
    return np.where(logs_of(specs), np.log(np.maximum(values, least)), values)
