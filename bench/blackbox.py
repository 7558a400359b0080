"""All black-box studies one after the other: `make bench`.

    python bench/blackbox.py [--quick] [--peers PYTHON] [--bag BAG]

Accuracy, start values on random plants, memory, speed (ratios in one run). The full run takes
some ten minutes on one core, --quick one. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent


def ran(script: str, *arguments: str) -> dict[str, object]:
    """Run one script, pass its table on, and take the JSON object of its last line."""
    print(f'\n{script} {" ".join(arguments)}'.rstrip(), flush=True)
    environment = {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', **os.environ}
    done = subprocess.run(
        [sys.executable, str(HERE / script), *arguments], stdout=subprocess.PIPE, text=True,
        check=True, env=environment,
    )
    lines = done.stdout.splitlines()
    print('\n'.join(lines[:-1]), flush=True)
    found: dict[str, object] = json.loads(lines[-1])
    return found


def main() -> None:
    """Run them all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='a tenth of the runs')
    parser.add_argument('--peers', metavar='PYTHON', help='a Python with sippy_unipi, sysidentpy')
    parser.add_argument('--bag', metavar='BAG', help='time the command on it (default: simulated)')
    options = parser.parse_args()
    more = [*(['--peers', options.peers] if options.peers else []),
            *(['--bag', options.bag] if options.bag else [])]
    print(json.dumps({
        'speed': ran('blackbox_speed.py', *more),
        'memory': ran('blackbox_memory.py'),
        'accuracy': ran('blackbox_accuracy.py', '40' if options.quick else '400'),
        'random_plants': ran('blackbox_random_plants.py', '100' if options.quick else '1000'),
    }))


if __name__ == '__main__':
    main()
