"""The cascade retuned without changing its structure: C1 P and C2 PID of one axis.

Minimised: tracking error of a square wave, with a small share of the deviation under a torque
step and of the noise at the motors, each relative to the gains that flew. Subject to margins of
every loop of the ensemble. What is judged stands in objective.py, the search in search.py.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from quad_sysid.loop.cascade import TUNED, CascadeGains
from quad_sysid.loop.plant import LoopPlant
from quad_tuning.assess import LoopFigures, assess
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.objective import Requirements, Weights, meets, pose
from quad_tuning.search import Found, search

__all__ = ['PidDesign', 'Requirements', 'Weights', 'meets', 'retune']

AGREED = 0.01
RELAXED_DISTURBANCE = 1.5
"""Where the flown gains reject a torque only without margins, this much of it may be lost."""


@dataclass(frozen=True)
class PidDesign:
    """Gains found, what they give, what the flown ones gave, and how sure the optimum is."""

    gains: CascadeGains
    figures: LoopFigures
    before: LoopFigures
    objective: float
    spread_pct: float
    """Largest difference of a gain that matters (angle kp, rate kp) between those that agree."""
    objective_spread_pct: float
    starts: int
    """Searches that ended within AGREED of the best objective."""
    searches: int
    """Searches that ended inside all requirements; the others stopped at lesser optima."""
    grid_points: int
    grid_excess_pct: float
    """By how much the best grid point that holds is worse than the optimum; negative: better."""
    disturbance_kept: bool
    """Whether a torque is rejected no worse than with the flown gains."""


def retune(
    plant: LoopPlant,
    active: CascadeGains,
    ensemble: Ensemble,
    needs: Requirements | None = None,
    weights: Weights | None = None,
    fixed: Collection[str] = (),
) -> PidDesign:
    """The best gains within the hard bounds that hold for every loop of the ensemble.

    `fixed` are fields of CascadeGains that stay as they are. Deterministic. Raises
    DesignRefusedError where no gains in the box meet the requirements.
    """
    needs = needs or Requirements()
    problem = pose(plant, active, ensemble, needs, weights or Weights(), fixed)
    found, kept = search(problem), True
    if not found.points:
        kept = False
        factor = RELAXED_DISTURBANCE * needs.disturbance_factor
        problem = replace(problem, needs=replace(needs, disturbance_factor=factor))
        found = search(problem)
    if not found.points:
        raise DesignRefusedError(_why_not(plant, active, ensemble))
    objective, best = found.points[0]
    chosen = problem.gains(best)
    agreed = [(value, x) for value, x in found.points if value <= (1.0 + AGREED) * objective]
    spreads = _spreads([problem.gains(x) for _, x in agreed], chosen)
    return PidDesign(
        gains=chosen,
        figures=assess(plant, chosen, ensemble),
        before=assess(plant, active, ensemble),
        objective=objective,
        spread_pct=100.0 * spreads,
        objective_spread_pct=100.0 * (agreed[-1][0] / objective - 1.0),
        starts=len(agreed),
        searches=len(found.points),
        grid_points=found.grid_points,
        grid_excess_pct=_excess(found, objective),
        disturbance_kept=kept,
    )


def _spreads(gains: list[CascadeGains], chosen: CascadeGains) -> float:
    return max(
        abs(float(getattr(g, f)) / float(getattr(chosen, f)) - 1.0)
        for g in gains for f in TUNED[:2]
    )


def _excess(found: Found, objective: float) -> float:
    return 100.0 * (found.grid_best / objective - 1.0)


def _why_not(plant: LoopPlant, active: CascadeGains, ensemble: Ensemble) -> str:
    figures = assess(plant, active, ensemble)
    return (
        f'no gains within the hard bounds keep the margins over {ensemble.draws} draws (flown: '
        f'phase margin {figures.worst_phase_margin_deg:.0f} deg, gain margin '
        f'{figures.worst_gain_margin_db:.1f} dB, sensitivity '
        f'{figures.worst_peak_sensitivity:.2f} at worst); identify with more excitation, or '
        'lower the gains by hand first'
    )
