"""`quad-sysid export`: arguments and wiring only."""

from __future__ import annotations

import argparse
from pathlib import Path

from quad_sysid.arguments import Commands, command, effects_option, own_effects
from quad_sysid.contract import AXES
from quad_sysid.files import check_new, write_whole


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(commands, 'export', _run,
                     'Write a model for python-control or MATLAB.',
                     'quad-sysid export result/model.json --to mat --out aircraft.mat')
    parser.add_argument('model', metavar='MODEL.json', type=Path)
    parser.add_argument('--to', required=True, choices=['control', 'mat'],
                        help='control: a Python file; mat: MATLAB')
    parser.add_argument('--axis', choices=AXES, help='default: every axis of the model')
    parser.add_argument('--out', metavar='FILE', type=Path,
                        help='default: beside the model, with the suffix of the format')
    effects_option(parser)
    parser.add_argument('--quiet', action='store_true', help='print nothing but errors')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.exports.files import WRITERS
    from quad_sysid.report.model_file import load_models, pick

    models = load_models(options.model, own_effects(options.effects))
    if options.axis is not None:
        models = pick(models, options.axis, options.model)
    write, suffix = WRITERS[options.to]
    out = options.out or options.model.with_name(f'{options.model.stem}_export{suffix}')
    check_new(out)
    write_whole(out, write(models))
    if not options.quiet:
        print(f'{out}: {", ".join(models)}')
    return 0
