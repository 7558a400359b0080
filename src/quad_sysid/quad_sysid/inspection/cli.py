"""`quad-sysid inspect`: arguments and wiring only."""

from __future__ import annotations

import argparse
import json
import sys

from quad_sysid.arguments import NOT_ANSWERED, Commands, command, quiet_and_json


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'inspect', _run,
        'Show on one page what a bag holds and what it can be used for, without a fit.',
        'quad-sysid inspect flight/',
    )
    parser.add_argument('bag', metavar='BAG', help='rosbag2 directory or .mcap file')
    quiet_and_json(parser, 'one JSON object')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.inspection.content import content  # numba and scipy: only where needed
    from quad_sysid.inspection.page import lines, tree

    held = content(options.bag)
    if options.json:
        print(json.dumps(tree(held), indent=1))
    elif not options.quiet:
        print('\n'.join(lines(held)))
    answers = [use.possible for one in held.axes for use in one.uses]
    if not any(answers):
        why = held.unusable or '; '.join(
            f'{one.axis}: {u.because}' for one in held.axes for u in one.uses
        )
        print(f'quad-sysid: {options.bag}: {why}', file=sys.stderr)
        return NOT_ANSWERED
    return 0
