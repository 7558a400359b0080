"""`quad-sysid look`: the command."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from quad_sysid.arguments import Commands, command, log_options, progress, quiet_and_json
from quad_sysid.errors import BadInputError


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'look', _run,
        'Measure what any log or bag shows without a model: step response, spectra, loop, '
        'delays, motors, tracking. Seconds, no identification.',
        'quad-sysid look LOG00001.BFL --out look.html', reads='file', writes='file',
    )
    parser.add_argument('file', metavar='FILE', nargs='+', help='a log of PX4, ArduPilot, '
                        'Betaflight or INAV, a table, or a bag; several are laid over one another')
    parser.add_argument('--out', metavar='HTML', help='the page to write (default: FILE_look.html '
                        'in this folder; an older one of look is replaced)')
    log_options(parser)
    parser.add_argument('--no-page', action='store_true', help='write no page')
    quiet_and_json(parser, 'one JSON object (of several files a list)')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.files import check_page, write_whole
    from quad_sysid.logview import several
    from quad_sysid.logview.read import look

    if len(options.file) > several.MOST:
        raise BadInputError('look', f'takes {several.MOST} files at most', len(options.file))
    show = progress(quiet=options.quiet)
    looks = []
    for file in options.file:
        show(f'reading {file}')
        looks.append(look(file, log=options.log, messages=options.messages))
    only = looks[0] if len(looks) == 1 else None
    out = None
    if not options.no_page:
        from quad_sysid.logview.page import MARK, page

        name = Path(options.file[0]).resolve().name.partition('.')[0] or 'log'
        stem = name if only else 'several'
        out = Path(options.out or f'{stem}_look.html')
        check_page(out, MARK, 'look')
        show('drawing')
        write_whole(out, page(only) if only else several.page(looks))
    show('')
    if options.json:
        trees = [look.tree() for look in looks]
        print(json.dumps(trees[0] if only else trees, indent=1))
    elif not options.quiet:
        print(only or '\n'.join(several.figures(looks).text()))
        if out is not None:
            print(f'\npictures in {out}')
    return 0
