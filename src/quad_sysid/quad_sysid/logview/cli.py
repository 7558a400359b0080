"""`quad-sysid look`: the command."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from quad_sysid.arguments import Commands, command, progress, quiet_and_json
from quad_sysid.errors import BadInputError


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'look', _run,
        'Measure what any log or bag shows without a model: step response, spectra, loop, '
        'delays, motors, tracking. Seconds, no identification.',
        'quad-sysid look LOG00001.BFL --out look.html', reads='file', writes='file',
    )
    parser.add_argument('file', metavar='FILE', help='a log of PX4, ArduPilot, Betaflight or '
                        'INAV, a table, or a bag')
    parser.add_argument('--out', metavar='HTML', help='the page to write (default: FILE_look.html '
                        'in this folder; an older one of look is replaced)')
    parser.add_argument('--log', metavar='N', type=int, default=1,
                        help='of several logs in one blackbox file (default 1)')
    parser.add_argument('--messages', metavar='FOLDER', type=Path,
                        help='checkout with the .msg files of a bag that holds no definitions')
    parser.add_argument('--no-page', action='store_true', help='write no page')
    quiet_and_json(parser, 'one JSON object')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.files import write_whole
    from quad_sysid.logview.read import look

    show = progress(quiet=options.quiet)
    show(f'reading {options.file}')
    found = look(options.file, log=options.log, messages=options.messages)
    out = None
    if not options.no_page:
        from quad_sysid.logview.page import MARK, page

        out = Path(options.out or f'{_stem(Path(options.file))}_look.html')
        if out.exists() and MARK not in out.read_text(encoding='utf-8', errors='replace')[:2000]:
            raise BadInputError(str(out), 'exists, and is no page of quad-sysid look',
                                remedy='name another with --out')
        show('drawing')
        write_whole(out, page(found))
    show('')
    if options.json:
        print(json.dumps(found.tree(), indent=1))
    elif not options.quiet:
        print(found)
        if out is not None:
            print(f'\npictures in {out}')
    return 0


def _stem(path: Path) -> str:
    return path.resolve().name.partition('.')[0] or 'log'
