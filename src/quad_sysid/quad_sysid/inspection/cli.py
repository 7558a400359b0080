"""`quad-sysid inspect`: the command."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quad_sysid.arguments import (
    BAD_ARGUMENTS,
    NOT_ANSWERED,
    Commands,
    command,
    log_options,
    quiet_and_json,
)
from quad_sysid.report.words import by_reason

if TYPE_CHECKING:
    from quad_sysid.inspection.content import Content

SCHEMA = 'quad_sysid/inspection/1'


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'inspect', _run,
        'Show on one page what a bag or log holds and what it can be used for, without a fit.',
        'quad-sysid inspect flight/', reads='bag', writes='file',
    )
    parser.add_argument('bag', metavar='BAG', help='rosbag2 directory, .mcap file, a log of PX4, '
                        'ArduPilot, Betaflight or INAV, or a table')
    log_options(parser)
    parser.add_argument('--out', metavar='HTML', type=Path,
                        help='write a page too, with the motors drawn in their places')
    quiet_and_json(parser, 'one JSON object')


def _run(options: argparse.Namespace) -> int:
    # numba and scipy: only where needed
    from quad_sysid.inspection.content import content
    from quad_sysid.inspection.text import lines

    report = content(options.bag, options.log, options.messages)
    if options.out is not None:
        from quad_sysid.files import check_page, write_whole
        from quad_sysid.inspection.page import MARK, page

        check_page(options.out, MARK, 'inspect')
        write_whole(options.out, page(report))
    if options.json:
        print(json.dumps(tree(report), indent=1))
    elif not options.quiet:
        print('\n'.join(lines(report)))
    if report.unusable:
        print(f'quad-sysid: {report.unusable}', file=sys.stderr)
        return BAD_ARGUMENTS
    answers = [use.possible for axis in report.axes for use in axis.uses]
    if not any(answers):
        why = by_reason({axis.axis: '; '.join(use.because for use in axis.uses)
                         for axis in report.axes})
        print(f'quad-sysid: {options.bag}: {why}', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def tree(content: Content) -> Mapping[str, Any]:
    """The content as plain values for `--json`: the dataclasses' fields by name."""
    return {'schema': SCHEMA, **asdict(content)}
