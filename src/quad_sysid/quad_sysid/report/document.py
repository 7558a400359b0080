"""report.json: the answers as the contract's tree of plain values. No arithmetic, no files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from quad_sysid.model import EffectEstimate, GainProposal, Parameter
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report.residual_tree import residual_tree
from quad_sysid.report.selection import row_tree, selection_tree

SCHEMA = 'quad_sysid/report/1'
METRIC = 'rms of the rate over free-run windows of 0.5 s'


def document(
    answers: Mapping[str, AxisAnswer],
    bags: Sequence[str],
    inertia: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """The tree of report.json; `inertia` in kg m² by axis adds torques in N m."""
    return {
        'schema': SCHEMA,
        'bags': list(bags),
        'axes': {
            axis: _axis(answer, (inertia or {}).get(axis)) for axis, answer in answers.items()
        },
    }


def _axis(answer: AxisAnswer, inertia: float | None) -> dict[str, Any]:
    model = answer.model
    found = answer.discovery
    tree: dict[str, Any] = {
        'sample_rate_hz': answer.sample_rate_hz,
        'segments': [
            {'role': s.role, 'signal': s.signal, 'start_s': s.start_s, 'end_s': s.end_s}
            for s in answer.segments
        ],
        'models': [row_tree(row) for row in answer.rows],
        'selected': answer.selected,
        'verdict': answer.verdict,
        'reason': answer.reason,
        'effects': [_effect(e, inertia) for e in model.effects] if model else [],
        'not_tested': [
            {'name': name, 'because': because}
            for name, because in (found.not_tested if found else ())
        ],
        'tried': [
            {'step': t.step, 'name': t.name, 'variant': t.variant, 'screened_out': t.screened,
             'cross_validated_error': _number(t.score), 'p_value': _number(t.p_value)}
            for t in (found.tried if found else ())
        ],
        'dependence': [
            {'on': d.name, 'cross_validated_error': _number(d.score),
             'p_value': _number(d.comparison.p_value)}
            for d in (found.dependence[:8] if found else ())
        ],
        'base': {'parameters': [_parameter(p, inertia) for p in (model.plain if model else ())]},
        'completed': {
            'parameters': [_parameter(p, inertia) for p in (model.base if model else ())]
        },
        'error': _error(answer),
        'trusted_band_rad_s': list(model.trusted_band_rad_s)
        if model and model.trusted_band_rad_s else None,
        'residual': residual_tree(answer.residuals),
        'warnings': list(answer.warnings),
        **selection_tree(answer.selection),
    }
    tree.update(_gains(answer.proposal))
    return tree


def _effect(effect: EffectEstimate, inertia: float | None) -> dict[str, Any]:
    tree: dict[str, Any] = {
        'name': effect.name,
        'kind': effect.kind,
        'signals': list(effect.signals),
        'parameters': [_parameter(p, inertia) for p in effect.parameters],
        'p_value': effect.p_value,
        'error_reduction_pct': effect.error_reduction_pct,
        'rivals': [{'name': name, 'probability': p} for name, p in effect.rivals],
        'probability': min(max(effect.probability, 0.0), 1.0),
    }
    variant = effect.settings.get('variant')
    if variant:
        tree['variant'] = variant
    knots, values = effect.settings.get('knots'), effect.settings.get('values')
    if isinstance(knots, tuple | list) and isinstance(values, tuple | list):
        tree['curve'] = {'x': list(knots), 'y': list(values)}
    return tree


def _parameter(parameter: Parameter, inertia: float | None) -> dict[str, Any]:
    tree: dict[str, Any] = {
        'name': parameter.name,
        'value': parameter.value,
        'std': _number(parameter.std),
        'unit': parameter.unit,
    }
    if parameter.std is not None:
        tree['interval_95'] = [
            parameter.value - 1.96 * parameter.std, parameter.value + 1.96 * parameter.std
        ]
    elif parameter.interval is not None:
        tree['interval_95'] = list(parameter.interval)
    if inertia is not None and parameter.unit.startswith('rad/s²'):
        tree['torque'] = {
            'value': parameter.value * inertia,
            'unit': parameter.unit.replace('rad/s²', 'N m', 1),
        }
    return tree


def _error(answer: AxisAnswer) -> dict[str, Any]:
    judgement = answer.judgement
    tree: dict[str, Any] = {'metric': METRIC, 'unit': 'rad/s', 'data': 'held-out'}
    if judgement is None:
        return {**tree, 'before': None, 'after': None, 'blackbox': None, 'noise_floor': None,
                'one_step_before': None, 'one_step_after': None, 'closed_loop_before': None,
                'closed_loop_after': None}
    loop = answer.closed_loop
    return {
        **tree,
        'before': _number(judgement.before.free_run),
        'after': _number(judgement.after.free_run),
        'blackbox': _number(answer.blackbox_error),
        'noise_floor': _number(judgement.noise_floor),
        'one_step_before': _number(judgement.before.one_step),
        'one_step_after': _number(judgement.after.one_step),
        'closed_loop_before': _number(loop.rms_before) if loop else None,
        'closed_loop_after': _number(loop.rms_after) if loop else None,
        'before_interval_95': list(judgement.before.interval),
        'after_interval_95': list(judgement.after.interval),
        'hold_last_value': _number(judgement.hold),
        'windows': int(judgement.before.run.errors.shape[0]),
        'p_value': _number(judgement.test.p_value),
    }


def _gains(proposal: GainProposal | None) -> dict[str, Any]:
    if proposal is None:
        return {'gains': None}
    if proposal.gains is None:
        return {'gains': None, 'gains_refused_because': proposal.refused_because}
    return {
        'gains': {name: float(value) for name, value in proposal.gains.items()},
        'gain_figures': {
            name: _number(float(value)) for name, value in proposal.figures.items()
        },
        'gain_steps': [dict(step) for step in proposal.steps],
        'gain_schedule': [
            {'battery_v': volts, 'gains': dict(gains)} for volts, gains in proposal.schedule
        ],
        'effects_used': [{'name': name, 'use': use} for name, use in proposal.used],
    }


def _number(value: float | None) -> float | None:
    """A finite number or null: JSON has nothing else."""
    return None if value is None or not math.isfinite(value) else float(value)
