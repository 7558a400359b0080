"""The demo's command line: arguments in, stages run, exit status out. The story is in story.py."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from quad_sysid.report.store import free_folder
from quad_tuning.demo.processes import StageFailedError
from quad_tuning.demo.story import Console, run_demo


def fresh_folder(folder: Path) -> Path | None:
    """Make `folder`; where it holds something, rename that first and return its new path.

    Raises FileExistsError where `folder` is a file.
    """
    aside = None
    if folder.is_dir() and any(folder.iterdir()):
        aside = free_folder(folder)
        folder.rename(aside)
    folder.mkdir(parents=True, exist_ok=True)
    return aside


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; 0 done, 1 where a stage failed (its reason is on stderr), 130 on Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog='demo',
        description='Close the loop once on a virtual quadrotor: fly, log, identify, find what '
        'is missing, design gains, send them, fly again, compare.',
        epilog='example: demo --out /tmp/demo_out --seed 7',
    )
    parser.add_argument('--out', type=Path, default=Path('demo_out'), help='result folder')
    parser.add_argument('--seed', type=int, default=1, help="seed of the virtual sensors' noise")
    parser.add_argument('--lockstep', action='store_true', help='in simulated time, which waits '
                        'for the slowest process; faster where it can')
    parser.add_argument('--qemu', action='store_true', help="fly the STM32's own ELF in QEMU, in "
                        'lockstep (make qemu says what that needs)')
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    out = options.out.absolute()
    try:
        aside = fresh_folder(out)
        console = Console()
        if aside is not None:
            console.say(f'kept the results of an earlier run as {aside.name}')
        lockstep = options.lockstep or options.qemu
        for line in run_demo(out, options.seed, console, lockstep=lockstep, qemu=options.qemu):
            sys.stdout.write(line + '\n')
    except (StageFailedError, OSError) as error:
        simulated = options.lockstep or options.qemu or isinstance(error, OSError)
        remedy = '' if simulated else '; on a busy machine add --lockstep'
        sys.stderr.write(f'demo failed: {error}{remedy} (logs: {out / "logs"})\n')
        return 1
    except KeyboardInterrupt:
        sys.stderr.write('demo interrupted; all of its processes are stopped\n')
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
