"""`quad-sysid import`: arguments and wiring only."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from quad_sysid.arguments import Commands, command
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError

TABLE_ONLY: Mapping[str, str] = {
    'axis': '--axis', 'time': '--time', 'control': '--control', 'motors': '--motors',
    'rate': '--rate', 'angle': '--angle', 'reference': '--reference', 'battery': '--battery',
    'unit': '--unit',
}
"""Options that name columns, which a log of a known kind does not need."""


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'import', _run,
        'Turn a log of PX4, ArduPilot or Betaflight, or any CSV, into a bag of the contract. The '
        'kind is told by the file; only a plain CSV needs the options that name columns.',
        'quad-sysid import flight.ulg --out bag/, or quad-sysid import log.csv --axis roll '
        '--time t --control u --rate gx --unit gx=deg/s --out bag/',
    )
    parser.add_argument('file', metavar='FILE', type=Path,
                        help='.ulg, .bin, blackbox CSV, plain CSV; tables also gzipped')
    parser.add_argument('--out', metavar='BAG', type=Path, required=True)
    parser.add_argument('--quiet', action='store_true', help='print nothing but errors')
    table = parser.add_argument_group('for a plain CSV')
    table.add_argument('--axis', choices=AXES)
    table.add_argument('--time', metavar='COL')
    source = table.add_mutually_exclusive_group()
    source.add_argument('--control', metavar='COL', help='command of the axis')
    source.add_argument('--motors', metavar='COL,COL,COL,COL', help='the four motors')
    table.add_argument('--mixer', metavar='x|plus|crazyflie|FILE',
                       help='what the motors mean (default x)')
    table.add_argument('--rate', metavar='COL', help='measured rate; else from --angle')
    table.add_argument('--angle', metavar='COL', help='measured angle or position')
    table.add_argument('--reference', metavar='COL')
    table.add_argument('--reference-is', choices=['angle', 'rate'], default='angle')
    table.add_argument('--battery', metavar='COL')
    table.add_argument('--unit', metavar='COL=UNIT', action='append', default=[],
                       help='such as gx=deg/s, u=V, t=ms, or a factor: u=0.05; repeat')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.imports.kinds import Kind, kind_of

    columns = [flag for name, flag in TABLE_ONLY.items() if getattr(options, name)]
    kind = kind_of(options.file)
    if kind is Kind.CSV or (kind is Kind.BETAFLIGHT and columns):
        return _table(options)
    if columns:
        raise BadInputError(
            f'{options.file}', f'is {kind.value}, which needs no column names',
            ', '.join(columns), 'leave them out',
        )
    return _log(options)


def _log(options: argparse.Namespace) -> int:
    from quad_sysid.imports.kinds import kind_of, read_log
    from quad_sysid.imports.to_bag import import_log
    from quad_sysid.imports.words import table

    done = import_log(read_log(options.file, kind_of(options.file)), options.out)
    if not options.quiet:
        print('\n'.join(table(done)))
        print(f'\nnext: quad-sysid inspect {done.path}')
    return 0


def _table(options: argparse.Namespace) -> int:
    from quad_sysid.bags import read_bag
    from quad_sysid.bags.importer import ImportOptions, import_csv, parse_units

    for name in ('axis', 'time'):
        if getattr(options, name) is None:
            raise BadInputError(
                f'{options.file}', f'is a plain CSV, which needs --{name}',
                remedy='see quad-sysid import --help',
            )
    if options.mixer is not None and not options.motors:
        raise BadInputError(
            '--mixer', 'belongs to --motors, a --control column is behind no mixer',
            options.mixer, 'leave it out or give --motors',
        )
    motors = tuple(options.motors.split(',')) if options.motors else ()
    path = import_csv(ImportOptions(
        file=options.file, axis=options.axis, time=options.time, out=options.out,
        control=options.control, motors=motors, mixer=options.mixer or 'x', rate=options.rate,
        angle=options.angle, reference=options.reference, reference_is=options.reference_is,
        battery=options.battery, units=parse_units(options.unit),
    ))
    record = read_bag(path)
    if not options.quiet:
        print(f'{path}: {record.n} samples at {1.0 / record.dt:g} Hz, '
              f'{record.n * record.dt:.1f} s')
        for warning in record.warnings:
            print(f'  {warning}')
        print(f'\nnext: quad-sysid inspect {path}')
    return 0
