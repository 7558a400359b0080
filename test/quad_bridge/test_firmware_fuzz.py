"""Random bytes, frames and damage into the firmware, under the sanitizers."""

import re
import subprocess

import pytest

LONG = pytest.mark.long


@pytest.mark.parametrize(
    ('seed', 'number', 'least'),
    [
        (3, 500_000, 20),
        pytest.param(1, 100_000_000, 1000, marks=LONG),
    ],
)
def test_no_bytes_break_it(firmware, seed, number, least):
    run = subprocess.run(
        [firmware('fuzz'), str(seed), str(number)],
        capture_output=True, text=True, timeout=1800, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    # it has come to the depths: frames heeded, excitation flown, gain sets taken back
    used, bad, excited, reverts, unsigned, forged = (
        int(re.search(rf'(\d+) {word}', run.stdout)[1])
        for word in ('frames used', 'bad', 'cycles excited', 'reverts', 'unsigned', 'forged')
    )
    assert min(used, bad, excited, unsigned, forged) > least
    assert reverts > least // 50
