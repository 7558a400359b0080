"""report.json: the answers as the contract's tree of plain values. No arithmetic, no files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Horizon
from quad_sysid.discover.search import Scored, SearchResult
from quad_sysid.errors import BadInputError
from quad_sysid.model import AxisModel, EffectEstimate, GainProposal, NoiseEstimate, Parameter
from quad_sysid.pipeline.answer import AxisAnswer, Findings, ModelRow, Residual
from quad_sysid.record import Segment
from quad_sysid.units import Units, in_units_of, unit_and_factor
from quad_sysid.whole import Whole

SCHEMA = 'quad_sysid/report/1'
METRIC = 'rms of the rate over free-run windows of 0.5 s'
RESIDUALS = ('before', 'after', 'blackbox')
SENTENCES = ('metric', 'reason', 'advice', 'because')
"""Fields of an axis that hold sentences."""
ERRORS = ('before', 'after', 'reference', 'blackbox', 'noise_floor', 'one_step_before',
          'one_step_after',
          'closed_loop_before', 'closed_loop_after')


def document(answers: Mapping[str, AxisAnswer], bags: Sequence[str],
             inertia: Mapping[str, float] | None = None,
             whole: Whole | None = None) -> dict[str, Any]:
    """The tree of report.json; `inertia` in kg m² by axis adds torques in N m."""
    axes = {axis: _axis(answer, (inertia or {}).get(axis)) for axis, answer in answers.items()}
    return dict(plain({'schema': SCHEMA, 'bags': bags, 'axes': axes,
                       **({'aircraft': whole.tree} if whole else {})}))


def answers_of(report: Mapping[str, Any],
               models: Mapping[str, AxisModel]) -> dict[str, AxisAnswer]:
    """The answers that a report's tree holds, by axis, each with its model and without the flight.

    Raises BadInputError for what is no report.
    """
    try:
        return {axis: _answer(axis, tree, models.get(axis))
                for axis, tree in report['axes'].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise BadInputError('report', 'is not of quad-sysid identify', str(error)) from error


def _answer(axis: str, tree: Mapping[str, Any], model: AxisModel | None) -> AxisAnswer:
    segments = tuple(Segment(s['role'], s['signal'], axis, 'unknown', s['start_s'], s['end_s'])
                     for s in tree['segments'])
    proposal = GainProposal(
        tree['gains'], tree.get('gains_refused_because', ''), tree.get('gain_figures', {}),
        tree.get('gain_left_out', {}), tuple(tree.get('gain_steps', ())))
    return AxisAnswer(axis, tree['sample_rate_hz'], segments, tree['verdict'], tree['reason'],
                      model=model, warnings=tuple(tree['warnings']), proposal=proposal)


def plain(value: Any) -> Any:
    """The value for JSON: lists for tuples, None for numbers that are not finite."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _axis(answer: AxisAnswer, inertia: float | None) -> dict[str, Any]:
    model, findings = answer.model, answer.findings
    labels = [e.label for e in model.own_effects if e is not model.law] if model else []

    def parameters(group: Sequence[Parameter]) -> list[dict[str, Any]]:
        return [_parameter(p, model, inertia) for p in group if model and model.shows(p)]

    units = answer.units
    per_rate = unit_and_factor(units, 'rad/s')[1]
    return dict(_worded(units, {
        'sample_rate_hz': answer.sample_rate_hz,
        'segments': [
            {'role': s.role, 'signal': s.signal, 'start_s': s.start_s, 'end_s': s.end_s,
             **({'because': s.parameters['because']} if 'because' in s.parameters else {})}
            for s in answer.segments
        ],
        'models': [_model(row) for row in answer.rows],
        'selected': answer.selected,
        'verdict': answer.verdict,
        'reason': answer.reason,
        'effects': [_effect(e, model, inertia) for e in model.effects] if model else [],
        'explanation': _explanation(findings, per_rate),
        'reproducible': {'blocks': findings.ladder.blocks, **findings.ladder.reproducible}
        if findings else {},
        'not_tested': [{'name': name, 'because': because}
                       for name, because in (findings.search.reasons.items() if findings else ())],
        'tried': _tried(findings, labels) if findings else [],
        'own_effects': _own(findings, labels) if findings else [],
        'base': {'parameters': parameters(model.plain if model else ()),
                 'noise': _noise(model.plain_noise, model.dt, units) if model else []},
        'completed': {'parameters': parameters(model.base if model else ()),
                      'noise': _noise(model.noise, model.dt, units) if model else []},
        'error': _error(answer),
        'outside': [vars(excess) for excess in answer.outside],
        'trusted_band_rad_s': (model and model.trusted_band_rad_s) or None,
        'residual': {name: _residual(answer.residuals[name], units)
                     if name in answer.residuals else None for name in RESIDUALS},
        'warnings': answer.warnings,
        'approaches': [asdict(approach) for approach in answer.selection.approaches],
        'feedback': answer.selection.feedback, 'advice': answer.selection.advice,
        **_gains(answer.proposal), 'flown_gains': dict(model.active_gains) if model else {},
    }))


def _worded(units: Units | None, tree: Any, key: str = '') -> Any:
    """The tree with the words of an axis that moves."""
    if isinstance(tree, Mapping):
        return {name: _worded(units, item, name) for name, item in tree.items()}
    if isinstance(tree, list | tuple):
        return [_worded(units, item, key) for item in tree]
    return in_units_of(units, tree) if isinstance(tree, str) and key in SENTENCES else tree


def _effect(effect: EffectEstimate, model: AxisModel, inertia: float | None) -> dict[str, Any]:
    knots, units = effect.settings.get('knots'), model.units
    if isinstance(knots, tuple | list) and units is not None:
        knots = [units.signal_in(effect.signals[0], x) for x in knots]
    parameters = [model.in_units(p) for p in effect.parameters]
    return {
        'name': effect.name,
        'kind': effect.kind,
        'signals': effect.signals,
        'parameters': [_parameter(p, model, inertia) for p in effect.parameters],
        'p_value': effect.p_value,
        'error_reduction_pct': effect.error_reduction_pct,
        'explains_pct': effect.explains_pct,
        'rivals': [{'name': name, 'probability': p} for name, p in effect.rivals],
        'probability': min(max(effect.probability, 0.0), 1.0),
        **({'variant': effect.variant} if effect.variant else {}),
        **({'curve': {'x': knots, 'y': [p.value for p in parameters
                                        if p.name.startswith(('y', 'slope_'))]}}
           if isinstance(knots, tuple | list) else {}),
    }


def _explanation(findings: Findings | None, per_rate: float) -> list[dict[str, Any]]:
    """The rungs above the base: effects, the share that they explain, the held-out error."""
    if findings is None:
        return []
    rungs = zip(findings.ladder.rungs, findings.verdict.rungs, strict=True)
    return [
        {'effects': [part.effect.name for part in rung.model.structure.parts],
         'explains_pct': rung.explains_pct, 'error': per_rate * error,
         'answer': rung is findings.ladder.rungs[findings.ladder.answer]}
        for rung, error in list(rungs)[1:]
    ]


def _noise(noise: NoiseEstimate | None, dt: float, units: Units | None) -> list[dict[str, Any]]:
    """Torque disturbance and measurement noise; errors of these are not estimated.

    A vibration is stated below half the sample rate: samples do not tell its aliases apart.
    """
    if noise is None:
        return []
    return [
        {'name': name, 'value': factor * value, 'std': None, 'unit': unit_text}
        for name, value, unit in (
            ('disturbance_rms', noise.disturbance_rms, 'rad/s²'),
            ('disturbance_correlation', noise.correlation_s, 's'),
            ('measurement_rms', noise.measured_rms, 'rad/s'),
            *((f'slow_noise_{i}', rms * noise.gyro_rms, 'rad/s') if width > frequency
              else (f'vibration_{i}', abs(frequency - round(frequency * dt) / dt), 'Hz')
              for i, (rms, frequency, width) in enumerate(noise.lines, 1)),
        ) for unit_text, factor in (unit_and_factor(units, unit),)
    ]


def _tried(findings: Findings, own_labels: Sequence[str]) -> list[dict[str, Any]]:
    """Structures that were fitted, the most probable first; not all without effects of one's own.

    The best of each of these is listed.
    """
    search = findings.search
    base = next(scored.score for scored in search.all if not scored.fit.structure.parts)
    best = {_best_with(search, label) for label in own_labels}
    return [
        {'effects': scored.fit.structure.labels, 'log_evidence_over_base': scored.score - base,
         'probability': float(p), 'converged': scored.fit.converged}
        for place, (scored, p) in enumerate(zip(search.all, search.probabilities(), strict=True))
        if place < 40 or scored in best
    ]


def _own(findings: Findings, own_labels: Sequence[str]) -> list[dict[str, Any]]:
    """What became of the user's effects, by their labels."""
    search = findings.search
    out: list[dict[str, Any]] = []
    base, leading = search.of_names(()), search.all[0]
    added = findings.verdict.chosen.structure.labels
    for label in own_labels:
        best = _best_with(search, label)
        if label in search.reasons or best is None:
            out.append({'name': label, 'outcome': 'not_tested',
                        'because': search.reasons.get(label, '')})
        else:
            out.append({
                'name': label, 'outcome': 'added' if label in added else 'not_added',
                'with': [other for other in best.fit.structure.labels if other != label],
                'log_evidence_over_base': best.score - base,
                'best': {'effects': leading.fit.structure.labels,
                         'log_evidence_over_base': leading.score - base},
            })
    return out


def _best_with(search: SearchResult, label: str) -> Scored | None:
    """The most probable structure with an effect."""
    return next((scored for scored in search.all if label in scored.fit.structure.labels), None)


def _parameter(inside: Parameter, model: AxisModel, inertia: float | None) -> dict[str, Any]:
    parameter = model.in_units(inside)
    tree: dict[str, Any] = {'name': parameter.name, 'value': parameter.value,
                            'std': parameter.std, 'unit': parameter.unit}
    if parameter.std is not None:
        half = 1.96 * parameter.std
        tree['interval_95'] = [parameter.value - half, parameter.value + half]
    elif parameter.interval is not None:
        tree['interval_95'] = parameter.interval
    if inertia is not None and inside.unit.startswith('rad/s²'):
        tree['torque'] = {'value': inside.value * inertia,
                          'unit': inside.unit.replace('rad/s²', 'N m', 1)}
    return tree


def _error(answer: AxisAnswer) -> dict[str, Any]:
    findings, loop = answer.findings, answer.closed_loop
    unit, factor = unit_and_factor(answer.units, 'rad/s')
    tree: dict[str, Any] = {'metric': METRIC, 'unit': unit, 'data': 'held-out',
                            **dict.fromkeys(ERRORS)}
    if findings is None:
        return {**tree, 'horizons': []}
    verdict = findings.verdict
    return {**tree, 'windows': int(findings.before.errors.shape[0]), **_times(factor, {
            'before': verdict.before, 'after': verdict.after,
            'blackbox': answer.blackbox_error, 'noise_floor': verdict.noise_floor,
            'reference': verdict.reference, 'one_step_before': verdict.one_step_before,
            'one_step_after': verdict.one_step_after,
            'closed_loop_before': loop and loop.rms_before,
            'closed_loop_after': loop and loop.rms_after,
            'before_interval_95': findings.before.interval,
            'after_interval_95': findings.after.interval, 'hold_last_value': verdict.hold,
            'predicted_by_noise': verdict.predicted,
            'horizons': horizons_tree(verdict.horizons, answer.blackbox_horizons)})}


def _times(factor: float, tree: Any) -> Any:
    """A tree with its numbers but for horizons in another unit."""
    if isinstance(tree, Mapping):
        return {name: item if name == 'horizon_s' else _times(factor, item)
                for name, item in tree.items()}
    if isinstance(tree, list | tuple):
        return [_times(factor, item) for item in tree]
    return None if tree is None else factor * tree


def horizons_tree(horizons: Sequence[Horizon],
                  blackbox: Mapping[float, float]) -> list[dict[str, Any]]:
    """Errors over the horizons, as the contract's `error.horizons`."""
    return list(plain([
        {'horizon_s': h.horizon_s, 'hold': h.hold, 'before': h.before, 'after': h.after,
         'blackbox': blackbox.get(h.horizon_s)}
        for h in horizons
    ]))


def _gains(proposal: GainProposal | None) -> dict[str, Any]:
    if proposal is None or proposal.gains is None:
        why = {} if proposal is None else {'gains_refused_because': proposal.refused_because}
        return {'gains': None, **why}
    return {'gains': proposal.gains, 'gain_figures': proposal.figures,
            'gain_steps': proposal.steps, 'gain_left_out': dict(proposal.left_out)}


def _model(row: ModelRow) -> dict[str, Any]:
    """The entry of `models`: both steps, and why it was eliminated."""
    tree: dict[str, Any] = row.step_a.as_report()
    because = [tree.pop('eliminated_because'), row.second_step_because]
    runs = [asdict(run) for run in row.loop_runs]
    tree |= {
        'closed_loop_fit_pct': row.closed_loop_fit_pct,
        'passed_second_step': row.passed_second_step,
        'closed_loop': [{k: v for k, v in run.items() if k != 'diverged' and v != ''}
                        for run in runs],
    }
    if any(because):
        tree['eliminated_because'] = '; '.join(filter(None, because))
    return tree


def _residual(residual: Residual, units: Units | None) -> dict[str, Any]:
    """Tests of one model's residual: values only."""
    test, missing = residual.test, residual.missing
    (unit, factor), (torque, per_torque) = (
        unit_and_factor(units, si) for si in ('rad/s', 'rad/s²'))
    tree: dict[str, Any] = {
        'data': 'held-out', 'samples': test.samples, 'rms': factor * residual.rms,
        'unit': unit,
        'confidence': test.confidence,
        'white': bool(test.residual_white), 'p_white': test.p_white,
        'autocorrelation_bound': test.autocorrelation_bound,
        'largest_autocorrelation': _largest(test.lags[1:], test.autocorrelation[1:]),
        'uncorrelated_with_input': bool(test.residual_uncorrelated_with_input),
        'p_input': test.p_input,
        'cross_bound': test.cross_bound,
        'largest_cross_correlation': _largest(test.cross_lags, test.cross_correlation),
        'peaks': [{'frequency_hz': f, 'over_surroundings_db': 10.0 * math.log10(ratio)}
                  for f, ratio in residual.peaks[:6]],
    }
    if missing is not None:
        at_s, value = missing.largest
        tree['missing_torque'] = {'unit': torque, 'at_s': at_s, **_times(per_torque, {
            'rms': missing.rms, 'expected_rms': missing.expected_rms, 'largest': value})}
    return tree


def _largest(lags: np.ndarray, values: FloatArray) -> dict[str, Any]:
    i = int(np.argmax(np.abs(values)))
    return {'lag_samples': int(lags[i]), 'value': float(values[i])}
