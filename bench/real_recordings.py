"""Recordings of other people from file to report by the documented commands: a table of answers.

`python bench/real_recordings.py FOLDER OUT` imports and identifies what of RECORDINGS lies in
FOLDER or in shared/data; what has its report in OUT is not run again. The answer for EMPS goes to
OUT/emps_answer.csv, for bench/results. The origins stand in docs/results/recordings.md.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

SHARED = Path(__file__).resolve().parents[2] / 'shared/data'
COARSE = ('--grid', '250')
MOTORS = 'motor_motor_m1,motor_motor_m2,motor_motor_m3,motor_motor_m4'
NANOBENCH = (
    '--axis', 'all', '--time', 't', '--motors', MOTORS, '--mixer', 'crazyflie',
    '--rate', 'imu_gyro_x,imu_gyro_y,imu_gyro_z', '--angle', 'roll,pitch,yaw',
    '--battery', 'pwr_pm_vbat', *(w for m in MOTORS.split(',') for w in ('--unit', f'{m}=pwm16')),
)  # fmt: skip
EMPS = (
    '--axis', 'roll', '--time', 't', '--control', 'vir', '--angle', 'qm', '--reference', 'qg',
    '--unit', 'vir=V', '--unit', 'qm=m', '--unit', 'qg=m',
)  # fmt: skip
RECORDINGS: dict[str, tuple[str, ...]] = {
    **{f'flights/crazypad_{name}.csv': ()
       for name in ('normal', 'weight_near_m3', 'propeller_cut_1mm')},
    **{f'flights/lee_{name}.csv': ()
       for name in ('standard_1', 'standard_2', 'upgraded_motors', 'payload_5g')},
    'log10': COARSE, 'log15': COARSE, 'log16': COARSE,
    'flights/crazyflie_1khz_roll_pitch.csv': COARSE,
    **{f'nanobench/{name}_rep1.csv.gz': NANOBENCH
       for name in ('B2_circle_fast', 'B3_figure8_fast', 'B7_oval_fast', 'B10_lissajous_fast')},
    'LOG00037.BFL': COARSE, 'btfl_001.bbl': ('--log', '2', *COARSE), 'btfl_002.bbl': COARSE,
    'Hiro_highP_highD.BFL': COARSE, 'Hiro_lowP_lowD.BFL': COARSE,
    'LOG00001.BFL': ('--grid', '400'), '20160412.TXT': COARSE,
    'blackbox_log_2026-02-21_145057.TXT': ('--log', '3', *COARSE), 'LOG00281.BFL': COARSE,
    'log_0036.bin': (), 'sample.bin': (), 'sample.ulg': (), 'px4/sample_log_small.ulg': (),
    'independent/flight': (), 'emps/DATA_EMPS.csv': EMPS,
}  # fmt: skip
"""By file: the options of its import. Those of a table without any are the guessed ones."""


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """`quad-sysid` with these arguments."""
    return subprocess.run(
        [sys.executable, '-m', 'quad_sysid.cli', *arguments], capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def imported(file: Path, options: tuple[str, ...], bag: Path) -> str:
    """The import's output in one line, or its error."""
    if '--axis' not in options:  # a table's line is guessed, a log needs none
        done = command('import', str(file))
        lines = [one for one in done.stdout.splitlines() if one.startswith('quad-sysid import')]
        guessed = shlex.split((lines or [''])[-1])[3:]
        if done.returncode or '--out' not in guessed:
            return ' '.join((done.stdout + done.stderr).split())
        options = (*guessed[: guessed.index('--out')], *options)
    done = command('import', str(file), *options, '--out', str(bag))
    return ' '.join((done.stdout + done.stderr).split())


def row(name: str, said: str, axes: dict[str, Any], seconds: float) -> str:
    """One line of the table."""
    motors = re.findall(r'motors on (\w+): ([-+0 ]+) explain ([\d.e-]+) %[^(]*\(([^)]*)\)', said)
    used = re.search(r'no experiment: (\d+ s) train, (\d+ s) are held out', said)
    layout = '; '.join(
        f'{axis} `{signs}` {float(share):.0f} %{"" if "not told" not in sure else " (unsure)"}'
        for axis, signs, share, sure in motors
    )
    verdicts, figures, reach = [], [], []
    for axis, answer in axes.items():
        names = ', '.join(e['name'] for e in answer['effects'])
        verdicts.append(f'{axis} `{answer["verdict"]}`{f" ({names})" if names else ""}')
        base = {p['name']: p['value'] for p in (answer['base'] or {}).get('parameters', ())}
        if base.get('gain') and base.get('lag'):
            figures.append(
                f'{axis} {base["gain"] / base["lag"]:,.0f}; {1e3 * base["delay"]:.1f}'
            )
        horizons = (answer['error'] or {}).get('horizons') or ()
        halves = [
            h['horizon_s'] for h in horizons
            if 2.0 * min(x for x in (h['before'], h['after']) if x is not None) <= h['hold']
        ]  # fmt: skip
        if halves:
            reach.append(f'{axis} {max(halves):g} s')
    cells = (
        name, ', '.join(used.groups()) if used else '', layout, '; '.join(verdicts),
        '. '.join(figures), ', '.join(reach), f'{seconds:.0f}',
    )  # fmt: skip
    return f'| {" | ".join(cells)} |'


def answer(axis: dict[str, Any]) -> str:
    """The main cause as a file of bench/results; a bag says rad where the slide has m."""
    cause = axis['effects'][0]
    size, again = cause['parameters'][0], axis['reproducible'][cause['name']]
    rung = next(one for one in axis['explanation'] if one['answer'])
    return ('cause,size,explains,again\n'
            f'`{cause["name"]}`,{size["value"]:.3g} {size["unit"].replace("rad", "m")},'
            f'{rung["explains_pct"]:.0f} %,{100.0 * again:.0f} %\n')


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path)
    parser.add_argument('out', type=Path)
    parser.add_argument('--only', nargs='+', default=[], help='parts of names')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    head = 'recording', 'train, held out', 'motors', 'verdict', 'gain/lag; ms', 'halves', 'CPU s'
    print(f'| {" | ".join(head)} |')
    for name, how in RECORDINGS.items():
        file = SHARED / name if (SHARED / name).exists() else options.folder / name
        wanted = not options.only or any(part in name for part in options.only)
        if not file.exists() or not wanted:
            continue
        stem = options.out / name.replace('/', '_')
        notes, result = Path(f'{stem}.txt'), Path(f'{stem}_result')
        if not (result / 'report.json').exists():
            bag = file if file.is_dir() else Path(f'{stem}_bag')
            said = '' if bag.exists() else imported(file, how, bag)
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            done = command('identify', str(bag), '--out', str(result)) if bag.exists() else None
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            told = done.stdout + done.stderr if done else ''
            notes.write_text(f'{spent:.0f}\n{said}\n{told}', encoding='utf-8')
        spent_text, said, *_ = notes.read_text(encoding='utf-8').splitlines()
        report = result / 'report.json'
        axes = json.loads(report.read_text(encoding='utf-8'))['axes'] if report.exists() else {}
        print(row(name, said, axes, float(spent_text)), flush=True)
        if name.startswith('emps') and axes:
            (options.out / 'emps_answer.csv').write_text(answer(axes['roll']), encoding='utf-8')
        if not axes:
            print(f'  no answer: {said[-200:]}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
