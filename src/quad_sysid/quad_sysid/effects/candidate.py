"""One candidate structure with what cross-validation says of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.crossval import held_out_errors
from quad_sysid.greybox.fit import Fit, fit_structure
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import BASE_PARAMETERS, Structure


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fitted structure; `errors` (windows,) held-out mean squared free-run errors."""

    fit: Fit
    errors: FloatArray

    @property
    def score(self) -> float:
        """Cross-validated RMS error, rad/s."""
        return float(np.sqrt(np.mean(self.errors)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the added effects."""
        return tuple(e.name for e in self.fit.structure.effects)

    @property
    def curves(self) -> int:
        """How many of the effects have no name: curves and hidden states."""
        return sum(e.kind != 'named' for e in self.fit.structure.effects)


def candidate(sim: Simulator, fit: Fit) -> Candidate:
    """Cross-validate a fit on its own training windows."""
    return Candidate(fit, held_out_errors(fit, sim.windows, sim.data.dt))


def without_effects(sim: Simulator, one: Candidate) -> Fit:
    """The base alone, fitted from where the candidate's base parameters are."""
    return fit_structure(sim, Structure(), one.fit.theta[: len(BASE_PARAMETERS)])


def without(sim: Simulator, chosen: Candidate, name: str) -> Candidate:
    """`chosen` less one effect, refitted."""
    structure = chosen.fit.structure
    keep = np.ones(chosen.fit.theta.size, dtype=bool)
    for effect, where in zip(structure.effects, structure.slices(), strict=True):
        if effect.name == name:
            keep[where] = False
    fit = fit_structure(sim, structure.without(name), chosen.fit.theta[keep])
    return candidate(sim, fit)
