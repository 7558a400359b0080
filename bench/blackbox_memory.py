"""Peak memory of the black-box fits on an hour at 250 Hz.

    python bench/blackbox_memory.py

Ends with one JSON object: MB before the record, with it, and at the peak; seconds.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from quad_sysid.blackbox import arx, bj, search_arx, step_a

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test'))
from known_plants import reference_study


def peak_mb() -> float:
    """Largest resident size so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    """Search, fit and judge on 900,000 samples."""
    before = peak_mb()
    z = replace(reference_study(), samples=900_000).record(np.random.default_rng(0))
    loaded = peak_mb()
    begin = time.perf_counter()
    search = search_arx(z, range(1, 11), range(1, 11), range(10))
    step_a([search.model, arx(z, 10, 10, 5), bj(z, 2, 2, 2, 2, 3)], z, {'prbs': z})
    seconds = time.perf_counter() - begin
    result = {
        'hour_imports_mb': round(before), 'hour_record_mb': round(loaded),
        'hour_peak_mb': round(peak_mb()), 'hour_s': round(seconds, 1),
    }
    for name, value in result.items():
        print(f'{name:40s} {value:12}')
    print(json.dumps(result))


if __name__ == '__main__':
    main()
