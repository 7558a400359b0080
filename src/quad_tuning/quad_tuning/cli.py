# PYTHON_ARGCOMPLETE_OK
"""`quad-tune design`: gains from a model.json, as a table or as JSON. Wiring only, no maths.

Exit status by the contract: 0 done, 2 bad input (one line on stderr), 3 no axis could be answered.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from quad_sysid.arguments import offer_completion
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel
from quad_sysid.report.model_file import load_models
from quad_tuning.bounds import BOUNDS
from quad_tuning.designer import design
from quad_tuning.errors import DesignRefusedError, QuadTuningError
from quad_tuning.exports import cli as exports
from quad_tuning.history import cli as history
from quad_tuning.state_feedback import LIMITS

SCHEMA = 'quad_tuning/design/1'
NO_ANSWER, INTERRUPTED = 3, 130
EXAMPLE = 'example: quad-tune design result/model.json --out gains.json'

ROWS: tuple[tuple[str, str, str], ...] = (
    ('phase_margin_deg', 'phase margin', 'deg'),
    ('worst_phase_margin_deg', '  worst of the draws', 'deg'),
    ('gain_margin_db', 'gain margin', 'dB'),
    ('worst_gain_margin_db', '  worst of the draws', 'dB'),
    ('peak_sensitivity', 'peak sensitivity', ''),
    ('worst_peak_sensitivity', '  worst of the draws', ''),
    ('worst_peak_complementary', 'worst complementary', ''),
    ('crossover_rad_s', 'crossover', 'rad/s'),
    ('bandwidth_rad_s', 'bandwidth', 'rad/s'),
    ('rise_time_s', 'rise time', 's'),
    ('overshoot_pct', 'overshoot', '%'),
    ('settling_time_s', 'settling time', 's'),
    ('rms_tracking_rad', 'RMS error, square wave', 'rad'),
    ('disturbance_rms_rad', 'RMS angle, torque step', 'rad'),
    ('motor_noise_rms', 'noise at the motors', ''),
)
"""Figure, its name in the table, unit."""


BRYSON = {'angle': 'RAD', 'rate': 'RAD/S', 'integral': 'RAD*S', 'control': 'SHARE'}
"""Options `--max-<name>` of the LQR's weights, and their units."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'{self.prog}: {message}; see --help\n')


def main(argv: Sequence[str] | None = None) -> int:
    """`quad-tune`: the exit status of the command that was asked for."""
    parser = _Parser(prog='quad-tune', description='Gains from identified models.')
    commands = parser.add_subparsers(dest='command', required=True)
    _arguments(commands.add_parser(
        'design', help='gains from a model.json, with margins', epilog=EXAMPLE,
    ))
    exports.add(commands)
    history.add(commands)
    offer_completion(parser)
    arguments = parser.parse_args(argv)
    try:
        status: int = arguments.run(arguments)
    except (QuadSysidError, QuadTuningError) as error:
        print(f'quad-tune: {error}', file=sys.stderr)
        return getattr(error, 'exit_status', 2)
    except KeyboardInterrupt:
        print('quad-tune: interrupted', file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return status


def design_main(argv: Sequence[str] | None = None) -> int:
    """`ros2 run quad_tuning design`: the same as `quad-tune design`."""
    return main(['design', *(sys.argv[1:] if argv is None else argv)])


def export_main(argv: Sequence[str] | None = None) -> int:
    """`ros2 run quad_tuning export`: the same as `quad-tune export`."""
    return main(['export', *(sys.argv[1:] if argv is None else argv)])


def history_main(argv: Sequence[str] | None = None) -> int:
    """`ros2 run quad_tuning history`: the same as `quad-tune history`."""
    return main(['history', *(sys.argv[1:] if argv is None else argv)])


def rollback_main(argv: Sequence[str] | None = None) -> int:
    """`ros2 run quad_tuning rollback`: the same as `quad-tune rollback`."""
    return main(['rollback', *(sys.argv[1:] if argv is None else argv)])


def send_main(argv: Sequence[str] | None = None) -> int:
    """`ros2 run quad_tuning send`: the same as `quad-tune send`."""
    return main(['send', *(sys.argv[1:] if argv is None else argv)])


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_run)
    parser.add_argument('model', type=Path, metavar='MODEL.json')
    parser.add_argument('--method', choices=('pid', 'lqr'), default='pid')
    parser.add_argument('--axis', choices=(*AXES, 'all'), default='all')
    parser.add_argument('--json', action='store_true', help='print JSON instead of the table')
    parser.add_argument('--quiet', action='store_true', help='print nothing but errors')
    parser.add_argument('--out', type=Path, metavar='FILE', help='write the JSON there too')
    parser.add_argument('--pictures', type=Path, metavar='DIR',
                        help='Bode, Nyquist and step with bands (pid)')
    bryson = parser.add_argument_group(
        'lqr', "Bryson's rule: the largest value of each that is acceptable"
    )
    for name, unit in BRYSON.items():
        bryson.add_argument(f'--max-{name}', type=_positive, metavar=unit)


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'must be a positive number: found {text}')
    return value


def _run(arguments: argparse.Namespace) -> int:
    models = load_models(arguments.model)
    axes = _wanted(models, arguments.axis, str(arguments.model))
    answers = {axis: _answer(models[axis], arguments) for axis in axes}
    tree = {'schema': SCHEMA, 'method': arguments.method, 'axes': answers}
    text = json.dumps(tree, indent=1, allow_nan=False)
    if arguments.out is not None:
        _write(arguments.out, text)
    if arguments.pictures is not None and arguments.method == 'pid':
        _draw(models, answers, arguments.pictures)
    if arguments.json:
        print(text)
    elif not arguments.quiet:
        for axis, answer in answers.items():
            print(_table(axis, arguments.method, answer))
    refusals = [a['refused_because'] for a in answers.values() if a['refused_because']]
    if len(refusals) == len(answers):
        print(f'quad-tune: no gains: {" | ".join(refusals)}', file=sys.stderr)
        return NO_ANSWER
    return 0


def _wanted(models: Mapping[str, AxisModel], axis: str, file: str) -> list[str]:
    if axis == 'all':
        return list(models)
    if axis not in models:
        raise BadInputError(
            f'{file}: axes', f'holds no model of {axis}', ', '.join(models),
            'ask for another --axis or identify it',
        )  # fmt: skip
    return [axis]


def _answer(model: AxisModel, arguments: argparse.Namespace) -> dict[str, Any]:
    if arguments.method == 'pid':
        proposal = design(model)
        gains = None if proposal.gains is None else dict(proposal.gains)
        return {
            'gains': gains,
            'target': dict(proposal.steps[-1]) if proposal.steps else None,
            'steps': [dict(step) for step in proposal.steps],
            'schedule': [
                {'battery_v': volts, 'gains': dict(row)} for volts, row in proposal.schedule
            ],
            'effects_used': [{'name': name, 'use': use} for name, use in proposal.used],
            'refused_because': proposal.refused_because,
            'figures': dict(proposal.figures),
        }
    from quad_tuning.lqr_proposal import propose_lqr  # python-control takes its time

    given = {name: getattr(arguments, f'max_{name}') for name in BRYSON}
    try:
        found = propose_lqr(model, {k: v for k, v in given.items() if v is not None})
    except DesignRefusedError as refusal:
        return {'gains': None, 'refused_because': str(refusal), 'figures': {}}
    return {'gains': found.gains, 'refused_because': '', 'figures': found.figures}


def _table(axis: str, method: str, answer: Mapping[str, Any]) -> str:
    if answer['refused_because']:
        return f'{axis} ({method}): no gains: {answer["refused_because"]}\n'
    figures = answer['figures']
    lines = [f'{axis} ({method}), over {figures["draws"]:.0f} draws of the model']
    lines.append(f'  {"":24}{"flown":>12}{"new":>12}  unit')
    for name, value in (answer.get('target') or answer['gains']).items():
        unit = _unit(name.partition('.')[2])
        lines.append(_row(name, figures.get(f'{name}_before'), value, unit))
    for key, name, unit in ROWS:
        if key in figures or f'{key}_before' in figures:
            lines.append(_row(name, figures.get(f'{key}_before'), figures.get(key), unit))
    if answer.get('steps'):
        lines.append(_updates(answer))
    lines += [f'  {item["name"]}: {item["use"]}' for item in answer.get('effects_used', ())]
    for row in answer.get('schedule', ()):
        gains = '  '.join(f'{name} {value:.4g}' for name, value in row['gains'].items())
        lines.append(f'  at {row["battery_v"]:.1f} V: {gains}')
    return '\n'.join(lines) + '\n'


def _unit(name: str) -> str:
    if name in BOUNDS:
        return BOUNDS[name].unit
    return LIMITS.get(name.partition('.')[2], (0.0, 1.0, ''))[2]


def _updates(answer: Mapping[str, Any]) -> str:
    count = len(answer['steps'])
    if answer['gains'] == answer['target']:
        return f'  to be sent whole; the step limit makes {count} updates of it'
    return (
        f'  {count} updates lead there; send {_short(answer["gains"])} first and identify again, '
        'all at once is not safe'
    )


def _short(gains: Mapping[str, float]) -> str:
    return ', '.join(f'{name} {value:.4g}' for name, value in gains.items())


def _draw(models: Mapping[str, AxisModel], answers: Mapping[str, Any], folder: Path) -> None:
    from quad_tuning.report.pictures import write_pictures  # matplotlib takes its time

    for axis, answer in answers.items():
        if answer['target'] is not None:
            known = {**models[axis].active_gains, **answer['target']}
            write_pictures(models[axis], CascadeGains.from_mapping(known, axis), folder)


def _row(name: str, before: float | None, after: float | None, unit: str) -> str:
    cells = ''.join(f'{"-" if value is None else f"{value:.4g}":>12}' for value in (before, after))
    return f'  {name:24}{cells}  {unit}'.rstrip()


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text + '\n', encoding='utf-8')
    except OSError as error:
        raise BadInputError(str(path), 'cannot be written', error.strerror) from error


if __name__ == '__main__':
    sys.exit(main())
