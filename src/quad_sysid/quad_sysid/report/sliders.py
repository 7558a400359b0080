"""Gains to try in the page: what sliders.js needs to redraw an axis' step, margins and noise.

The plant is sent as the linear one at the amplitudes of loop/linear.py, in wide motion and near
rest; of the controller, its parts over frequency, whose sum by the gains is the loop. The page
simulates a step of the wide plant with the controller's filters and limits.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np

from quad_sysid.errors import QuadSysidError
from quad_sysid.loop.cascade import TUNED, CascadeGains, contract_names, frequency_grid
from quad_sysid.loop.from_model import in_flight, loop_plant
from quad_sysid.loop.linear import ComplexArray, loops_of
from quad_sysid.model import AxisModel
from quad_sysid.units import in_units_of

SECONDS = 0.6
"""Length of the step over half a period of the axis' trial."""
STICK_S = 0.02
"""Time in which a rate set-point with feed-forward takes its step, as a stick does."""
STYLE = """.tryout label{display:flex;flex-wrap:wrap;gap:4px 12px;align-items:center}
.tryout input{flex:1 1 140px;min-width:0}.tryout output{min-width:8em}
.tryout svg{width:100%;max-width:640px}"""


def sliders(model: AxisModel, designed: Mapping[str, float]) -> str:
    """HTML of the sliders of an axis; '' where the gains that flew are not known."""
    try:
        data = loop_data(model, designed)
        text = json.dumps(data, separators=(',', ':'), allow_nan=False).replace('<', '\\u003c')
    except (QuadSysidError, ArithmeticError, ValueError) as error:  # the rest of the page stands
        return f'<p class="small">Not drawn: {escape(str(error))}</p>'
    if data is None:
        return ''
    return (f'<div class="tryout" role="group" aria-label="gains of {escape(model.axis)} to try">'
            f'<script type="application/json">{text}</script></div>'
            '<p class="small">The identified model, linear at wide motion, with the limits of the '
            'flight; margins are the smaller ones of wide motion and near rest. Noise: what of '
            + in_units_of(model.units, 'the gyro') + ' reaches the command, beside the gains that '
            'flew.</p>')


def loop_data(model: AxisModel, designed: Mapping[str, float]) -> dict[str, Any] | None:
    """Numbers that the page computes with; None where the gains that flew are not known."""
    axis, active = model.axis, model.active_gains
    if not active.get(f'{axis}.rate.kp', 0.0) > 0.0:
        return None
    model, names = in_flight(model), [contract_names(axis)[field] for field in TUNED]
    stick = f'{axis}.rate.tpa_kp' in active  # a blackbox log holds the stick's rate, no angle's
    flown_gains = CascadeGains.from_mapping(
        {names[0]: 0.0, **active} | ({names[0]: 0.0} if stick else {}), axis)
    plant = loop_plant(model)
    loops = loops_of([(plant, plant.trial.wide), (plant, plant.trial.near_rest)])
    omega = frequency_grid(model.dt, 200, 0.5, loops)
    rate, angle = loops.response(omega)
    none = replace(flown_gains, angle_kp=0.0, rate_kp=0.0, rate_ki=0.0, rate_kd=0.0, kff=0.0)

    def part(**gains: Any) -> ComplexArray:
        return replace(none, **gains).response(omega, model.dt)

    error = part(rate_kp=1.0)[0]
    return {
        'axis': axis, 'dt': model.dt,
        'steps': round(SECONDS * plant.trial.half_period_s / model.dt),
        'size': plant.trial.step if flown_gains.angle_kp else 1.0,
        'names': names,
        'flown': [float(getattr(flown_gains, field)) for field in TUNED],
        'designed': [float(designed.get(name, getattr(flown_gains, field)))
                     for name, field in zip(names, TUNED, strict=True)] if designed else None,
        'constants': {**{name: float(np.clip(value, -1e300, 1e300)) for name, value
                         in flown_gains.constants(model.dt)._asdict().items()},
                      'kff_slope': active.get(f'{axis}.rate.kff_slope', 0.0)},
        'rise_s': STICK_S if f'{axis}.rate.kff_slope' in active else 1e-9,
        'a': _numbers(loops.a[0], 10), 'b': _numbers(loops.b[0], 10),
        'c': _numbers(loops.c[0], 10),
        'omega': _numbers(omega), 'rate': _complex(rate), 'angle': _complex(angle),
        'parts': _complex(np.stack([error, part(rate_ki=1.0)[0], part(rate_kd=1.0)[0]])),
        'target': _complex(part(angle_kp=1.0, rate_kp=1.0)[1] / error),
        'forward': _complex(part(angle_kp=1.0, kff=1.0)[1]),
    }


def _numbers(values: Any, digits: int = 6) -> Any:
    """Nested lists of so many significant digits."""
    if np.ndim(values):
        return [_numbers(value, digits) for value in values]
    return float(f'{values:.{digits}g}')


def _complex(values: Any) -> dict[str, Any]:
    return {'re': _numbers(np.real(values)), 'im': _numbers(np.imag(values))}
