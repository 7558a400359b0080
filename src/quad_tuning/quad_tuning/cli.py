# PYTHON_ARGCOMPLETE_OK
"""`quad-tune design`: gains from a model.json, as a table or as JSON. Wiring only, no maths.

What takes long to import (numba, scipy) is imported where a design needs it.
Exit status by the contract: 0 done, 2 bad input (one line on stderr), 3 no axis could be answered.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quad_sysid.arguments import (
    NOT_ANSWERED,
    Parser,
    command,
    effects_option,
    own_effects,
    positive,
    quiet_and_json,
    run_command,
)
from quad_sysid.axes import EVERY
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_there, read_json, write_whole
from quad_sysid.model import BEFORE, AxisModel
from quad_sysid.report.tables import Table, figure_rows, wrapped
from quad_sysid.report.words import left_out, number
from quad_tuning import exports, history
from quad_tuning.errors import DesignRefusedError

BRYSON = {'angle': ('RAD', 0.1, 'angle error'), 'rate': ('RAD/S', 0.7, 'rate'),
          'integral': ('RAD*S', 0.2, 'integral of the angle error'),
          'control': ('SHARE', 0.1, 'command, as a share of its range')}
"""Options `--max-<name>` of the LQR's weights: unit, default of lqr.py, words."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `quad-tune`; returns its exit status."""
    parser = Parser.program('quad-tune', 'quad_tuning', 'Gains from identified models.',
                            'quad-tune design result/model.json --out gains.json')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    _arguments(command(commands, 'design', _run, 'Gains from a model.json, with margins.',
                       'quad-tune design result/model.json --out gains.json'))
    exports.add(commands)
    history.add(commands)
    return run_command(parser, argv)


def ros2() -> int:
    """`ros2 run quad_tuning design …`: the command that the executable is named after."""
    return main([Path(sys.argv[0]).name, *sys.argv[1:]])


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(writes='file')  # --out, checked before the design
    parser.add_argument('model', type=Path, metavar='MODEL.json',
                        help='written by quad-sysid identify, or its folder')
    parser.add_argument('--method', choices=('pid', 'lqr'), default='pid',
                        help='pid: the cascade of angle and rate (default); lqr: state feedback')
    parser.add_argument('--axis', metavar='AXES', help='roll, pitch, yaw, surge, sway or climb, '
                        'several with commas between (default: every axis of the model)')
    parser.add_argument('--flight', metavar='BAG',
                        help='a flight, of which notches are proposed where the frame shakes')
    effects_option(parser)
    quiet_and_json(parser, 'JSON')
    parser.add_argument('--out', type=Path, metavar='FILE',
                        help='write the JSON there too, over an earlier design')
    bryson = parser.add_argument_group(
        'with --method lqr', "Bryson's rule: the largest value of each that is acceptable"
    )
    for name, (unit, default, words) in BRYSON.items():
        bryson.add_argument(f'--max-{name}', type=float, metavar=unit,
                            help=f'{words}; default {default:g}')


def _run(arguments: argparse.Namespace) -> int:
    from quad_sysid.report.model_file import load_models, pick

    _check(arguments)
    models = load_models(arguments.model, own_effects(arguments.effects))
    chosen = pick(models, arguments.axis, arguments.model)
    answers = {axis: {**_answer(model, models, arguments), 'flown_gains': dict(model.active_gains)}
               for axis, model in chosen.items()}
    tree = {'schema': exports.DESIGN, 'method': arguments.method, 'axes': answers}
    if arguments.flight is not None:
        tree['notches'] = _notches(chosen, answers, arguments.flight)
    text = json.dumps(tree, indent=1, allow_nan=False)
    if arguments.out is not None:
        write_whole(arguments.out, text + '\n')
    if arguments.json:
        print(text)
    elif not arguments.quiet:
        for axis, answer in answers.items():
            print(_table(axis, arguments.method, answer))
        if 'notches' in tree:
            print(_notch_table(tree['notches']))
        if arguments.out is not None:
            print(f'design in {arguments.out}')
    refusals = [a['refused_because'] for a in answers.values() if a['refused_because']]
    if len(refusals) == len(answers):
        print(f'quad-tune: no gains: {" | ".join(refusals)}', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse, before the design, options that do not fit: a file there must be a design."""
    named = [name for name in BRYSON if getattr(arguments, f'max_{name}') is not None]
    if named and arguments.method != 'lqr':
        raise BadInputError(f'--max-{named[0]}', 'belongs to --method lqr, which is not given')
    if arguments.flight is not None:
        check_there(arguments.flight)
    if arguments.out is None or not arguments.out.exists():
        return
    try:
        tree = read_json(arguments.out)
    except BadInputError:
        tree = None
    if not isinstance(tree, dict) or tree.get('schema') != exports.DESIGN:
        raise BadInputError(str(arguments.out), 'exists, and is no design',
                            remedy='name another with --out')


def _answer(model: AxisModel, models: Mapping[str, AxisModel],
            arguments: argparse.Namespace) -> dict[str, Any]:
    model = model.predicting
    if arguments.method == 'pid':
        from quad_tuning.designer import design

        inner = models.get(EVERY[model.axis].excited_as)
        proposal = design(model, None if inner is None else inner.predicting)
        gains = None if proposal.gains is None else dict(proposal.gains)
        return {
            'gains': gains,
            'target': dict(proposal.steps[-1]) if proposal.steps else None,
            'steps': [dict(step) for step in proposal.steps],
            'refused_because': proposal.refused_because,
            'left_out': dict(proposal.left_out),
            'figures': dict(proposal.figures),
        }
    from quad_sysid.loop.from_model import not_in_the_loop
    from quad_tuning.lqr import Weights, propose_lqr

    largest = ((name, getattr(arguments, f'max_{name}')) for name in BRYSON)
    limits = {name: positive(f'--max-{name}', value) for name, value in largest
              if value is not None}
    if limits.get('control', 0.0) > 1.0:
        raise BadInputError('--max-control', 'is a share of the range, at most 1',
                            limits['control'])
    try:
        lqr = propose_lqr(model, Weights(**limits))
    except DesignRefusedError as refusal:
        return {'gains': None, 'refused_because': str(refusal), 'figures': {}}
    return {'gains': lqr.gains, 'refused_because': '', 'left_out': not_in_the_loop(model),
            'figures': lqr.figures}


def _table(axis: str, method: str, answer: Mapping[str, Any]) -> str:
    if answer['refused_because']:
        return f'{axis} ({method}): no gains: {answer["refused_because"]}\n'
    figures = answer['figures']
    rows = [
        [name, number(figures.get(f'{name}{BEFORE}'), 4), number(value, 4),
         _unit(name)]
        for name, value in (answer.get('target') or answer['gains']).items()
    ]
    lines = [f'{axis} ({method}), over {figures["draws"]:.0f} draws of the model',
             *Table(['', 'flown', 'new', 'unit'], [*rows, *figure_rows(figures, axis)],
                    (1, 2)).text()]
    if EVERY[axis].outer:
        lines += wrapped(f'For a position hold of your own, around the loop of '
                         f'{EVERY[axis].excited_as}: no firmware here has one, and quad-tune send '
                         'leaves these out. Flown: usual gains, where a flight names none.')
    elif answer.get('steps'):
        count, first = len(answer['steps']), history.words(answer['gains'])
        pace = f'{count} steps, 3 s apart' if count > 1 else 'one step'
        lines += wrapped(
            'quad-tune send sends what --out stores, if the aircraft still has the gains of the '
            f'flight; the bridge applies it in {pace}' if answer['gains'] == answer['target'] else
            f'{count} updates lead there, since all at once is not safe: send {first}, fly, and '
            'identify again')
    lines += wrapped(left_out(answer['left_out']))
    return '\n'.join(lines) + '\n'


def _notches(models: Mapping[str, AxisModel], answers: Mapping[str, Mapping[str, Any]],
             flight: str) -> list[dict[str, Any]]:
    """The notches that a flight asks for, with the gains of the design where there are such."""
    from quad_sysid.logview.read import look
    from quad_tuning.notches import propose_notches

    models = {axis: model for axis, model in models.items() if EVERY[axis].turns}
    if not models:
        raise BadInputError('--flight', 'places notches in the loops of roll, pitch and yaw',
                            remedy='leave it out, or design one of these axes too')
    gains: dict[str, float] = {}
    crossover = {}
    for axis, model in models.items():
        answer = answers[axis]
        gains |= {**model.active_gains, **(answer.get('target') or answer['gains'] or {})}
        if 'crossover_rad_s' in answer['figures']:
            crossover[axis] = answer['figures']['crossover_rad_s']
    looks = look(flight).whole.axes
    peaks = {axis: one.gyro.peaks() for axis, one in looks.items() if one.gyro is not None}
    dt = next(iter(models.values())).dt
    return [{**vars(one), 'gains': one.gains}
            for one in propose_notches(peaks, gains, crossover, dt)]


def _notch_table(notches: Sequence[Mapping[str, Any]]) -> str:
    if not notches:
        return 'notches: none; no shaking of the frame reaches the motors\n'
    rows = [[n['place'], n['axis'], number(n['frequency_hz'], 4), number(n['width_hz'], 3),
             number(100.0 * n['command_rms'], 2), number(100.0 * n['command_rms_after'], 2),
             number(n['phase_deg'], 2)] for n in notches]  # fmt: skip
    head = ['notch', 'axis', 'Hz', 'width', 'command %', 'behind it', 'phase, deg']
    gains = {name: value for n in notches for name, value in n['gains'].items()}
    return '\n'.join([*Table(head, rows, (2, 3, 4, 5, 6)).text(),
                      f'  send them by themselves: {history.words(gains)}']) + '\n'


def _unit(name: str) -> str:
    from quad_tuning.bounds import ROWS

    unit = ROWS[name].unit if name in ROWS else ''
    return '' if unit == '1' else unit


if __name__ == '__main__':
    sys.exit(main())
