"""report.json: the answers as the contract's tree of plain values. No arithmetic, no files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from quad_sysid.discover.accept import Horizon
from quad_sysid.model import EffectEstimate, GainProposal, NoiseEstimate, Parameter
from quad_sysid.pipeline.answer import AxisAnswer, Findings
from quad_sysid.report.residual_tree import residual_tree
from quad_sysid.report.selection import row_tree, selection_tree

SCHEMA = 'quad_sysid/report/1'
MOST_TRIED = 40
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
    model, findings = answer.model, answer.findings
    tree: dict[str, Any] = {
        'sample_rate_hz': answer.sample_rate_hz,
        'segments': [
            {'role': s.role, 'signal': s.signal, 'start_s': s.start_s, 'end_s': s.end_s,
             **({'because': s.parameters['because']} if 'because' in s.parameters else {})}
            for s in answer.segments
        ],
        'models': [row_tree(row) for row in answer.rows],
        'selected': answer.selected,
        'verdict': answer.verdict,
        'reason': answer.reason,
        'effects': [_effect(e, inertia) for e in model.effects] if model else [],
        'not_tested': [
            {'name': name, 'because': because}
            for name, because in (findings.found.reasons.items() if findings else ())
        ],
        'tried': _tried(findings) if findings else [],
        'base': {
            'parameters': [_parameter(p, inertia) for p in (model.plain if model else ())],
            'noise': _noise(model.plain_noise if model else None),
        },
        'completed': {
            'parameters': [_parameter(p, inertia) for p in (model.base if model else ())],
            'noise': _noise(model.noise if model else None),
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
    if effect.variant:
        tree['variant'] = effect.variant
    knots = effect.settings.get('knots')
    if isinstance(knots, tuple | list):
        tree['curve'] = {'x': list(knots), 'y': [p.value for p in effect.parameters[: len(knots)]]}
    return tree


def _noise(noise: NoiseEstimate | None) -> list[dict[str, Any]]:
    """Torque disturbance and measurement noise; errors of these are not estimated."""
    if noise is None:
        return []
    return [
        {'name': name, 'value': value, 'std': None, 'unit': unit}
        for name, value, unit in (
            ('disturbance_rms', noise.disturbance_rms, 'rad/s²'),
            ('disturbance_correlation', noise.correlation_s, 's'),
            ('measurement_rms', noise.measured_rms, 'rad/s'),
            *((f'vibration_frequency_{i}', line[1], 'Hz')
              for i, line in enumerate(noise.lines, 1)),
        )
    ]


def _tried(findings: Findings) -> list[dict[str, Any]]:
    """Structures that were fitted, the most probable first."""
    found = findings.found
    base = next(one.score for one in found.all if not one.fit.structure.parts)
    return [
        {'effects': list(one.fit.structure.labels), 'log_evidence_over_base': one.score - base,
         'probability': float(p), 'converged': one.fit.converged}
        for one, p in zip(found.all[:MOST_TRIED], found.probabilities(), strict=False)
    ]


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
    findings = answer.findings
    tree: dict[str, Any] = {'metric': METRIC, 'unit': 'rad/s', 'data': 'held-out'}
    if findings is None:
        return {**tree, 'before': None, 'after': None, 'blackbox': None, 'noise_floor': None,
                'one_step_before': None, 'one_step_after': None, 'closed_loop_before': None,
                'closed_loop_after': None, 'horizons': []}
    loop, verdict = answer.closed_loop, findings.verdict
    return {
        **tree,
        'before': _number(verdict.before),
        'after': _number(verdict.after),
        'blackbox': _number(answer.blackbox_error),
        'noise_floor': _number(verdict.noise_floor),
        'one_step_before': _number(verdict.one_step_before),
        'one_step_after': _number(verdict.one_step_after),
        'closed_loop_before': _number(loop.rms_before) if loop else None,
        'closed_loop_after': _number(loop.rms_after) if loop else None,
        'before_interval_95': [_number(v) for v in findings.before.interval],
        'after_interval_95': [_number(v) for v in findings.after.interval],
        'hold_last_value': _number(verdict.hold),
        'predicted_by_noise': _number(verdict.predicted),
        'windows': int(findings.before.errors.shape[0]),
        'e_value': _number(verdict.e_value),
        'horizons': horizons_tree(verdict.horizons, answer.blackbox_horizons),
    }


def horizons_tree(
    found: Sequence[Horizon], blackbox: Mapping[float, float]
) -> list[dict[str, Any]]:
    """How the error grows, as the contract's `error.horizons`."""
    return [
        {'horizon_s': one.horizon_s, 'hold': _number(one.hold), 'before': _number(one.before),
         'after': _number(one.after), 'blackbox': _number(blackbox.get(one.horizon_s))}
        for one in found
    ]


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
