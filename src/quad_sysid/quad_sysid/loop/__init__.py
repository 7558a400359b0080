"""The closed loop: the cascade C1/C2 around an identified plant, its margins and step figures."""

from quad_sysid.loop.cascade import CascadeGains, Margins, margins, open_loop
from quad_sysid.loop.figures import (
    SquareComparison,
    SquareFigures,
    StepFigures,
    compare_square,
    square_figures,
    square_wave,
    step_figures,
)
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import Curve, LoopPlant, state_space
from quad_sysid.loop.simulation import (
    LoopResponse,
    simulate_cascade,
    simulate_polynomial_cascade,
)

__all__ = [
    'CascadeGains',
    'Curve',
    'LoopPlant',
    'LoopResponse',
    'Margins',
    'SquareComparison',
    'SquareFigures',
    'StepFigures',
    'compare_square',
    'loop_plant',
    'margins',
    'open_loop',
    'simulate_cascade',
    'simulate_polynomial_cascade',
    'square_figures',
    'square_wave',
    'state_space',
    'step_figures',
]
