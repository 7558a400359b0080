"""`quad-sysid import`: the command, and what it says in 80 columns."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from quad_sysid.arguments import Commands, command, log_options, positive, quiet_and_json
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.imports.units import OPTIONS, columns_of, flag
from quad_sysid.report.tables import Table, wrapped

if TYPE_CHECKING:
    from quad_sysid.imports.formats import Format
    from quad_sysid.imports.log import ForeignLog
    from quad_sysid.imports.to_bag import Imported


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'import', _run,
        'Turn a log of PX4, ArduPilot, Betaflight, INAV or INDIflight, or any table, into a bag '
        'with the topics of this project. The file shows its format. A table needs the options '
        'that name columns: FILE alone lists them, guesses what they are and prints the command '
        'line.',
        'quad-sysid import flight.ulg --out bag/, or quad-sysid import log.csv --axis all '
        '--time t --motors m1,m2,m3,m4 --mixer auto --rate gx,gy,gz --unit gx=deg/s --out bag/',
        writes='folder',
    )
    parser.add_argument('file', metavar='FILE', type=Path,
                        help='.ulg, .bin, .log, .bbl, .bfl, CSV, .mat, bags of ROS 1 and 2, '
                        "a Crazyflie's SD card log; also packed (.gz, .xz, .bz2)")
    parser.add_argument('--out', metavar='BAG', type=Path,
                        help='without it, the contents are listed and nothing is written')
    parser.add_argument('--grid', metavar='HZ', type=float,
                        help='rate of the bag, at most 4 times that of the log (default: what the '
                        'times say)')
    log_options(parser)
    parser.add_argument('--mixer', metavar='auto|LAYOUT|FILE',
                        help='where the motors are: a layout such as x, plus, crazyflie, '
                        'ardupilot_hexa_x, betaflight_octox8, a URDF, or a YAML file with '
                        'matrix: (default what the log says, else x; auto: what the motion '
                        'shows)')
    quiet_and_json(parser, 'the columns of a table and their guesses as JSON')
    table = parser.add_argument_group(
        'for a table', 'COLS are columns separated by commas, one for each axis of --axis'
    )
    table.add_argument('--axis', metavar='roll|pitch|yaw|all',
                       help='one, several by commas, or all (default where there are three COLS)')
    for name, option in OPTIONS.items():
        table.add_argument(flag(name), metavar=option.metavar, help=option.help)
    table.add_argument('--sample-rate', metavar='HZ', type=float,
                       help='rate of the rows, where no column holds their time')
    table.add_argument('--frame', choices=('auto', 'flu', 'frd'), default='auto',
                       help="frd: y points right and z down; auto (default): flu, or what "
                       '--acceleration tells')
    table.add_argument('--unit', metavar='COL=UNIT', action='append', default=[],
                       help='such as gx=deg/s, u=V, t=ms, or a factor: u=0.05; repeat. A unit in '
                       'brackets in the header is read')
    table.add_argument('--gain', metavar='NAME=VALUE', action='append', default=[],
                       help='a gain that flew, such as roll.rate.kp=0.07 (normalised command per '
                       'rad/s) or roll.angle.kp=5 (1/s): a design of gains begins there; repeat')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.imports.formats import format_of

    columns = [flag(name) for name in ('axis', *OPTIONS, 'unit', 'sample_rate', 'gain')
               if getattr(options, name)]
    columns += ['--frame'] if options.frame != 'auto' else []
    log_format = format_of(options.file)
    if options.grid is not None:
        positive('--grid', options.grid)
    if options.sample_rate is not None:
        positive('--sample-rate', options.sample_rate)
    measured = not {'--axis', '--rate', '--angle'}.isdisjoint(columns)
    if log_format is None or (log_format.also_table and measured):
        return _table(options, columns)
    if columns:
        raise BadInputError(
            f'{options.file}', f'is {log_format.name}, which needs no column names',
            ', '.join(columns), 'leave them out',
        )
    return _log(options, log_format)


def _log(options: argparse.Namespace, log_format: Format) -> int:
    from quad_sysid.imports.formats import read_log
    from quad_sysid.imports.guess import quicker
    from quad_sysid.imports.mixers import mixer_of

    log = read_log(options.file, log_format, options.log, options.messages)
    if options.out is None:
        print('\n'.join([f'{options.file}: {log.kind}', '', *mapped(log), '', 'to import it:',
                         shlex.join(['quad-sysid', 'import', str(options.file), '--out',
                                     f'{options.file.stem}_bag']),
                         *quicker(log.rates.rate_hz if log.rates else 0.0)]))
        return 0
    if options.mixer is not None:
        if log.motors is None:
            raise BadInputError('--mixer', f'{options.file} holds no motor commands',
                                options.mixer, 'leave it out')
        motors = tuple(f'motor_{i + 1}' for i in range(log.motors.values.shape[1]))
        log = replace(
            log, crafts=() if options.mixer == 'auto' else (mixer_of(options.mixer, motors),)
        )
    return _write(log, options)


def _table(options: argparse.Namespace, columns: list[str]) -> int:
    from quad_sysid.imports.columns import ColumnOptions, parse_units, read_columns
    from quad_sysid.imports.formats import check_single
    from quad_sysid.imports.guess import described, lines
    from quad_sysid.imports.stated_gains import parse_gains
    from quad_sysid.imports.table import is_ours, open_table

    check_single(options.file, 'a table', options.log)
    if not columns:
        if is_ours(options.file):
            raise BadInputError(f'{options.file}', 'is a bag of this project already',
                                remedy=f'use quad-sysid inspect {options.file}')
        content = open_table(options.file, messages=options.messages)
        print(json.dumps(described(content, options.file)) if options.json
              else '\n'.join(lines(content, options.file, options.out)))
        if options.out is None:
            return 0
        raise BadInputError(f'{options.file}', 'is a table, whose columns need names',
                            remedy='check the command line above and type it')
    if options.out is None:
        raise BadInputError('--out', 'is missing', remedy='name the bag to be written')
    if options.mixer is not None and not options.motors:
        raise BadInputError('--mixer', 'applies to --motors only; --control columns need no mixer',
                            options.mixer, 'leave it out or give --motors')
    names = {name: columns_of(value) for name, option in OPTIONS.items()
             if (value := getattr(options, name)) and (option.per_axis or option.several)}
    return _write(read_columns(ColumnOptions(
        file=options.file, axes=_axes(options, names.get('rate') or names.get('angle', ())),
        gains=parse_gains(options.gain),
        time=options.time, thrust=options.thrust, mixer=options.mixer or 'x',
        battery=options.battery, units=parse_units(options.unit), frame=options.frame,
        sample_rate_hz=options.sample_rate, messages=options.messages, **names,
    )), options)


def _axes(options: argparse.Namespace, measured: tuple[str, ...]) -> tuple[str, ...]:
    """The axes of --axis."""
    if options.axis == 'all' or (options.axis is None and len(measured) == len(AXES)):
        return AXES
    if options.axis is None:
        raise BadInputError(f'{options.file}', 'is a table, which needs --axis',
                            remedy='see quad-sysid import --help')
    return tuple(options.axis.split(','))


def _write(log: ForeignLog, options: argparse.Namespace) -> int:
    from quad_sysid.imports.guess import quicker
    from quad_sysid.imports.to_bag import import_log

    done = import_log(log, options.out, options.grid)
    if not options.quiet:
        print('\n'.join(table(done)))
        print('\n'.join(['', f'next: quad-sysid inspect {shlex.quote(str(done.path))}',
                         *quicker(1.0 / done.record.dt)]))
    return 0


def table(done: Imported) -> list[str]:
    """Lines to print after an import."""
    record = done.record
    out = [
        str(done.path),
        (f'{done.log.kind}, {record.n} samples at {1.0 / record.dt:.5g} Hz, '
         f'{record.n * record.dt:.1f} s'), '', *mapped(done.log),
    ]
    for title, lines in (('clock and motors', done.notes), ('missing', done.log.missing),
                         ('warnings', done.warnings)):
        if lines:
            out += ['', title, *(part for line in lines for part in wrapped(line, '    ', '  '))]
    return out


def mapped(log: ForeignLog) -> list[str]:
    """The table of fields: from the log, to the bag."""
    rows = [[f'{m.source} [{m.unit}]', f'{m.rate_hz:.4g}' if m.rate_hz else '-', m.topic, m.how]
            for m in log.mapped]
    return Table(['from the log', 'Hz', 'to the bag', ''], rows, (1,)).text(below=3)
