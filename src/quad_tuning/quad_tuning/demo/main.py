"""The demo: its command line, and what flies in which order, with a message for each stage."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory

from quad_sysid.files import free_folder
from quad_tuning.demo.observer import Observer
from quad_tuning.demo.processes import Crew, StageFailedError, own_domain
from quad_tuning.demo.stages import (
    Aircraft,
    Campaign,
    await_new_gains,
    await_report,
    connect,
    fly,
    start_identification,
)
from quad_tuning.demo.summary import FlightSummary, Outcome, draw_square, flown_square, lines

AXIS = 'roll'
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Console:
    """Progress lines on stdout, each with the seconds since the demo began."""

    began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """Since the demo began."""
        return time.monotonic() - self.began

    def say(self, line: str) -> None:
        """One line, at once."""
        sys.stdout.write(f'[{self.seconds:5.1f} s] {line}\n')
        sys.stdout.flush()


def run_demo(out: Path, seed: int, console: Console, *, lockstep: bool = False,
             qemu: bool = False) -> list[str]:
    """Close the loop once, results in `out`; the lines of the summary.

    Raises StageFailedError; in any case all processes are stopped.
    """
    with (own_domain() as domain, Crew(out, domain, lockstep=lockstep) as crew,
          Observer(domain, crew.clock) as observer):
        campaign = Campaign(crew, observer, console.say)
        return lines(_close_the_loop(campaign, seed, console, qemu=qemu))


def _close_the_loop(campaign: Campaign, seed: int, console: Console, *, qemu: bool) -> Outcome:
    out = campaign.folder
    console.say('virtual STM32 on the rig, serial bridge')
    bearing = HERE / 'friction_bearing.py'
    connect(campaign, Aircraft('plain', AXIS, seed, effect_module=bearing, qemu=qemu))
    console.say('first flight, with the gains of the paper')
    start_identification(campaign, auto_update=True, axes=[AXIS])
    shared = Path(get_package_share_directory('quad_sysid'))
    first = fly(campaign, 'flight_1', shared / 'config' / 'schedule_demo.yaml')
    console.say('bag complete; the identification node works on it')
    report_path = await_report(campaign)
    report = _axis_report(report_path)
    console.say(f'verdict: {report["verdict"]}')
    waited = await_new_gains(campaign, first.gains)
    console.say(f'new gains sent; all steps in force {waited:.1f} s later')
    campaign.crew.stop('identification')
    console.say('second flight, with the new gains')
    second = fly(campaign, 'flight_2', HERE / 'second_flight.yaml')
    campaign.crew.stop()
    squares = [flown_square(flight.bag, AXIS) for flight in (first, second)]
    names = ('old gains', 'new gains')
    draw_square(out / 'square_wave.png', dict(zip(names, squares, strict=True)))
    unseen = _evaluate(report_path.with_name('model.json'), second.bag)
    console.say('both flights compared')
    return Outcome(
        axis=AXIS, report=report, unseen=unseen, acknowledged_after_s=waited, folder=out,
        first=FlightSummary(first.seconds, first.gains, squares[0].figures),
        second=FlightSummary(second.seconds, second.gains, squares[1].figures),
        files=[('bag of the first flight', first.bag), ('bag of the second flight', second.bag),
               ('the report, for people', report_path.with_name('report.html')),
               ('the same, for programs', report_path),
               ('the model, for quad-sysid evaluate', report_path.with_name('model.json')),
               ('pictures of the report', report_path.with_name('pictures')),
               ('picture of both square waves', out / 'square_wave.png'),
               ('for quad-tune history --folder', out / 'aircraft')],
        seconds=console.seconds,
    )


def _axis_report(path: Path) -> Mapping[str, Any]:
    report: Mapping[str, Any] = json.loads(path.read_text())
    if AXIS not in report['axes']:
        raise StageFailedError('identify', f'{path} holds no answer for {AXIS}')
    axis: Mapping[str, Any] = report['axes'][AXIS]
    return axis


def _evaluate(model: Path, bag: Path) -> Mapping[str, Any]:
    """Error figures of the stored model on a bag it has never seen, by the public command."""
    command = [sys.executable, '-m', 'quad_sysid.cli', 'evaluate', model, bag, '--json']
    done = subprocess.run([str(part) for part in command], capture_output=True,  # noqa: S603
                          text=True, check=False)
    if done.returncode != 0:
        raise StageFailedError('evaluate', done.stderr or f'status {done.returncode}')
    error: Mapping[str, Any] = json.loads(done.stdout)['axes'][AXIS]['error']
    return error


def fresh_folder(folder: Path) -> Path | None:
    """Make `folder`; where it holds something, rename that first and return its new path.

    Raises FileExistsError where `folder` is a file.
    """
    backup = None
    if folder.is_dir() and any(folder.iterdir()):
        backup = free_folder(folder)
        folder.rename(backup)
    folder.mkdir(parents=True, exist_ok=True)
    return backup


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
        backup = fresh_folder(out)
        console = Console()
        if backup is not None:
            console.say(f'kept the results of an earlier run as {backup.name}')
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
