"""Logs of autopilots whose physics is known: what import and identify say beside the truth.

    python bench/known_truth.py OUT

Reads shared/data/autopilots (its README has the truth) and writes OUT/known_truth.csv, for
bench/results.
"""

from __future__ import annotations

import argparse
import csv
import json
import lzma
import shutil
from pathlib import Path
from typing import Any

from real_recordings import SHARED, command

LOGS = {
    'Betaflight 2026.12': ('bf_sitl_quad.BFL', ('--grid', '500')),
    'PX4 1.17': ('px4_sih_quadx.ulg.xz', ()),
    'ArduCopter 4.7': ('ap_sitl_systemid.bin.xz', ()),
}
TRUTH: dict[tuple[str, str], tuple[dict[str, float], dict[str, float]]] = {
    ('Betaflight 2026.12', 'roll'): (
        {'gain': 879.0, 'lag': 0.030, 'damping': 2.50},
        {'thrust_curve': 0.896, 'inertia_coupling': -0.8125}),
    ('Betaflight 2026.12', 'pitch'): (
        {'gain': 639.0, 'lag': 0.030, 'damping': 1.82},
        {'thrust_curve': 0.896, 'inertia_coupling': 0.864}),
    ('Betaflight 2026.12', 'yaw'): (
        {'lag': 0.030, 'damping': 1.14}, {'mode:rotor_lead': 0.0, 'inertia_coupling': -0.171}),
    ('PX4 1.17', 'roll'): ({'gain': 160.0, 'lag': 0.048, 'damping': 1.0}, {}),
    ('PX4 1.17', 'pitch'): ({'gain': 160.0, 'lag': 0.048, 'damping': 1.0}, {}),
    ('PX4 1.17', 'yaw'): ({'gain': 13.33, 'lag': 0.048, 'damping': 0.833}, {}),
    ('ArduCopter 4.7', 'roll'): ({}, {}),
    ('ArduCopter 4.7', 'pitch'): ({}, {}),
    ('ArduCopter 4.7', 'yaw'): ({}, {}),
}
"""Of the base and of the effects' first parameters, SI; 0: known to be there, of unstated size."""


def read(log: str, out: Path) -> dict[str, Any]:
    """The axes of the report on a log."""
    name, options = LOGS[log]
    stem = out / name.partition('.')[0]
    file = out / name.removesuffix('.xz')
    if name.endswith('.xz'):
        with lzma.open(SHARED / 'autopilots' / name) as packed, file.open('wb') as whole:
            shutil.copyfileobj(packed, whole)
    else:
        shutil.copy(SHARED / 'autopilots' / name, file)
    command('import', str(file), *options, '--out', f'{stem}_bag')
    command('identify', f'{stem}_bag', '--out', f'{stem}_result')
    report = Path(f'{stem}_result') / 'report.json'
    axes: dict[str, Any] = json.loads(report.read_text(encoding='utf-8'))['axes']
    return axes


def beside(estimate: dict[str, Any], truth: float | None) -> str:
    """A value with its standard error, and the truth where it is known."""
    if estimate['std'] is None:
        said = f'below {estimate["interval_95"][1]:.2g}' if estimate.get('interval_95') else '–'
    else:
        said = f'{estimate["value"]:.4g} ± {estimate["std"]:.2g}'
    return said + (f' ({truth:g})' if truth else '')


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('out', type=Path)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    with (out / 'known_truth.csv').open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(['log', 'answer', 'gain, rad/s² per unit (truth)', 'lag, s',
                         'damping, 1/s', 'error before, after, rad/s'])
        for log in LOGS:
            for axis, tree in read(log, out).items():
                base, effects = TRUTH[log, axis]
                found = {p['name']: p for p in tree['completed']['parameters']}
                named = ', '.join(f'`{e["name"]}` '
                                  + beside(e['parameters'][0], effects.get(e['name']))
                                  for e in tree['effects'])
                error = tree['error']
                writer.writerow([
                    f'{log}, {axis}', named or f'`{tree["verdict"]}`',
                    *(beside(found[name], base.get(name)) for name in ('gain', 'lag', 'damping')),
                    f'{error["before"]:.3g}, {error["after"]:.3g}',
                ])
                file.flush()
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
