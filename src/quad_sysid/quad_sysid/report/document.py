"""report.json: the answers as the contract's tree of plain values. No arithmetic, no files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from quad_sysid.blackbox import Table2Entry
from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Horizon
from quad_sysid.model import EffectEstimate, GainProposal, NoiseEstimate, Parameter
from quad_sysid.pipeline.answer import (
    AxisAnswer,
    Findings,
    LoopRun,
    MissingTorque,
    ModelRow,
    Residual,
    Selection,
    SharedModel,
)

SCHEMA = 'quad_sysid/report/1'
MOST_TRIED = 40
MOST_PEAKS = 6
RESIDUALS = ('before', 'after', 'blackbox')
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


TABLE2_ROW = '{:<17}{:>7}{:>7}  {:>7}{:>7}  {:>7}{:>7}  {}'
POLYNOMIALS = 'ABCDF'


def row_tree(row: ModelRow) -> dict[str, Any]:
    """The entry of `models`: both steps, and why it was eliminated."""
    tree: dict[str, Any] = {
        **row.step_a.as_report(),
        'closed_loop_fit_pct': _number(row.closed_loop_fit_pct),
        'passed_second_step': row.passed_second_step,
        'closed_loop': [_run(run) for run in row.loop_runs],
    }
    because = [tree.pop('eliminated_because'), row.second_step_because]
    if any(because):
        tree['eliminated_because'] = '; '.join(line for line in because if line)
    return tree


def _run(run: LoopRun) -> dict[str, Any]:
    return {
        'bag': run.bag, 'gains_changed': run.gains_changed, 'signals': list(run.signals),
        'fit_pct': _number(run.fit_pct), 'rmse': _number(run.rmse), 'mae': _number(run.mae),
        **({'because': run.because} if run.because else {}),
    }


def selection_tree(selection: Selection) -> dict[str, Any]:
    """What an axis' tree says of how its black-box models were found and chosen."""
    tree: dict[str, Any] = {
        'approaches': [
            {'name': a.name, 'possible': a.possible, 'because': a.because}
            for a in selection.approaches
        ],
        'feedback': selection.feedback,
        'preparation': [
            {'name': c.name, 'kept': c.kept, 'words': c.words} for c in selection.checks
        ],
        'advice': list(selection.advice),
    }
    if selection.table2:
        tree['table2'] = [_entry(entry) for entry in selection.table2]
    if selection.shared is not None:
        tree['roll_and_pitch'] = _shared(selection.shared)
    return tree


def _entry(entry: Table2Entry) -> dict[str, Any]:
    paper = entry.paper
    return {
        'name': paper.name,
        'paper': {'prbs': paper.prbs_pct, 'square': paper.square_pct, 'train': paper.train_pct,
                  'kept': paper.kept},
        'fit_train_pct': entry.row and _number(entry.row.fit_train_pct),
        'fit_validation_pct': {
            name: _number(fit) for name, fit in entry.row.fit_validation_pct.items()
        } if entry.row else {},
        'passed_first_step': bool(entry.row and entry.row.passed_first_step),
        'because': entry.row.eliminated_because if entry.row else entry.refused_because,
    }


def _shared(shared: SharedModel) -> dict[str, Any]:
    model = shared.model
    return {
        'agree': shared.agree,
        'because': shared.because,
        'model': None if model is None else {
            'structure': model.structure, 'orders': dict(model.orders),
            **{name: getattr(model, name).tolist() for name in POLYNOMIALS},
        },
        'fit_validation_pct': {
            axis: _number(fit) for axis, fit in shared.fit_validation_pct.items()
        },
    }


def lines(tree: Mapping[str, Any]) -> list[str]:
    """What the terminal says of an axis' selection below its table of models."""
    out: list[str] = []
    broken = [c for c in tree.get('preparation', []) if c['kept'] is False]
    for title, items in (
        ('data preparation', [f'{c["name"]}: {c["words"]}' for c in broken]),
        ('advice', tree.get('advice', [])),
    ):
        if items:
            out += [title, *(part for item in items for part in _item(item))]
    shared = tree.get('roll_and_pitch')
    if shared:
        text = 'one model for roll and pitch' if shared['agree'] else 'roll and pitch: two models'
        out += _item(f'{text}; {shared["because"]}')
    out += table2_lines(tree.get('table2', []))
    return [*out, ''] if out else []


def table2_lines(entries: list[Mapping[str, Any]]) -> list[str]:
    """Our fits beside the paper's, per cent."""
    if not entries:
        return []
    out = [
        '', 'Table 2: fit in % here and, behind each, in the paper;',
        'train is the one-step fit, the others are free runs',
        TABLE2_ROW.format('model', 'train', '', 'prbs', '', 'square', '', 'first step'),
    ]
    for entry in entries:
        fits, paper = entry['fit_validation_pct'], entry['paper']
        name = entry['name'] + (' *' if paper['kept'] else '')
        out.append(
            TABLE2_ROW.format(
                name, _pct(entry['fit_train_pct']), _pct(paper['train']),
                _pct(fits.get('prbs')), _pct(paper['prbs']),
                _pct(fits.get('square')), _pct(paper['square']),
                'pass' if entry['passed_first_step'] else 'out',
            ).rstrip()
        )
        others = {n: v for n, v in fits.items() if n not in ('prbs', 'square')}
        if others:
            out += _item(', '.join(f'{n} {_pct(v)}' for n, v in others.items()))
        if entry['because']:
            out += _item(entry['because'])
    return [*out, '* kept in the paper']


def _item(text: str, width: int = 76) -> Iterator[str]:
    """Lines of a list's item, its first word behind a dash."""
    line, lead = '', '  - '
    for word in text.split():
        if line and len(line) + len(word) + 1 > width - len(lead):
            yield lead + line
            line, lead = word, '    '
        else:
            line = f'{line} {word}'.strip()
    if line:
        yield lead + line


def _pct(value: float | None) -> str:
    return '-' if value is None else f'{max(value, -999.0):.2f}'


def residual_tree(found: Mapping[str, Residual]) -> dict[str, Any]:
    """By model, in the order before, after, black box; null where there was too little to test."""
    return {name: _one(found[name]) if name in found else None for name in RESIDUALS}


def _one(residual: Residual) -> dict[str, Any]:
    test = residual.test
    tree: dict[str, Any] = {
        'data': 'held-out', 'samples': test.samples, 'rms': residual.rms, 'unit': 'rad/s',
        'confidence': test.confidence,
        'white': bool(test.residual_white), 'p_white': _number(test.p_white),
        'autocorrelation_bound': _number(test.autocorrelation_bound),
        'largest_autocorrelation': _largest(test.lags[1:], test.autocorrelation[1:]),
        'uncorrelated_with_input': bool(test.residual_uncorrelated_with_input),
        'p_input': _number(test.p_input),
        'cross_bound': _number(test.cross_bound),
        'largest_cross_correlation': _largest(test.cross_lags, test.cross_correlation),
        'peaks': [
            {'frequency_hz': f, 'over_surroundings_db': 10.0 * math.log10(ratio)}
            for f, ratio in residual.peaks[:MOST_PEAKS]
        ],
    }
    if residual.missing is not None:
        tree['missing_torque'] = _torque(residual.missing)
    return tree


def _torque(missing: MissingTorque) -> dict[str, Any]:
    at_s, value = missing.largest
    return {
        'unit': 'rad/s²', 'rms': missing.rms, 'expected_rms': missing.expected_rms,
        'largest': value, 'at_s': at_s,
    }


def _largest(lags: np.ndarray, values: FloatArray) -> dict[str, Any]:
    i = int(np.argmax(np.abs(values)))
    return {'lag_samples': int(lags[i]), 'value': _number(float(values[i]))}
