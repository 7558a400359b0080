"""`quad-tune export`: arguments and wiring only."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_new, read_json, write_whole
from quad_tuning.exports.parameters import FIRMWARES, lines, text


def add(commands: Any) -> None:
    """Register the command."""
    parser = commands.add_parser(
        'export', help='gains as a parameter file of PX4 or ArduPilot',
        description='Write designed gains as a parameter file of PX4 or ArduPilot, with each '
        'conversion as a comment.',
        epilog='example: quad-tune design result/model.json --out gains.json && '
        'quad-tune export gains.json --to px4 --scale roll=0.25',
    )
    parser.set_defaults(run=run)
    parser.add_argument('gains', metavar='GAINS.json', type=Path,
                        help='of quad-tune design --out, or a report.json')
    parser.add_argument('--to', choices=FIRMWARES, required=True)
    parser.add_argument('--scale', metavar='AXIS=NUMBER', action='append', default=[],
                        help="our command per unit of the firmware's torque; 1 where the model "
                        'was identified on its torque set-points; repeat')
    parser.add_argument('--out', metavar='FILE', type=Path, help='default: print it')


def run(arguments: argparse.Namespace) -> int:
    """Read, convert, print or write; raises BadInputError."""
    gains = read_gains(arguments.gains)
    found = lines(arguments.to, gains, scales(arguments.scale))
    content = text(arguments.to, found, arguments.gains.name)
    if arguments.out is None:
        print(content, end='')
        return 0
    check_new(arguments.out)
    write_whole(arguments.out, content)
    print(f'{len(found)} parameters in {arguments.out}')
    return 0


def scales(items: list[str]) -> dict[str, float]:
    """`AXIS=NUMBER` options by axis."""
    out = {}
    for item in items:
        axis, _, number = item.partition('=')
        with suppress(ValueError):
            out[axis] = float(number)
        if axis not in AXES or not out.get(axis, 0.0) > 0.0:
            raise BadInputError('--scale', 'needs AXIS=NUMBER', repr(item), 'such as roll=0.25')
    return out


def read_gains(path: Path) -> dict[str, float]:
    """The gains of all axes in a design or report: what is sent, before any target."""
    tree = read_json(path)
    axes = tree.get('axes') if isinstance(tree, dict) else None
    if not isinstance(axes, Mapping):
        raise BadInputError(f'{path}: axes', 'is missing',
                            remedy='give the file of quad-tune design --out, or a report.json')
    found: dict[str, float] = {}
    for one in axes.values():
        gains = one.get('gains') if isinstance(one, Mapping) else None
        if isinstance(gains, Mapping):
            found.update({str(name): float(value) for name, value in gains.items()})
    if not found:
        raise BadInputError(f'{path}: gains', 'holds none',
                            remedy='the design was refused, or this is a model: run quad-tune '
                            'design MODEL.json --out gains.json first')
    return found
