"""Random bytes, frames and damage into the C endpoint, under the sanitizers."""

import re
import subprocess

import pytest

BYTES = 10_000_000


@pytest.mark.parametrize('seed', [1, 2])
def test_no_bytes_break_it(firmware, seed):
    run = subprocess.run(
        [firmware('fuzz'), str(seed), str(BYTES)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    # it has come to the depths: frames heeded, excitation flown, gain sets taken back
    used, bad, excited, reverts, unsigned, forged = (
        int(re.search(rf'(\d+) {word}', run.stdout)[1])
        for word in ('frames used', 'bad', 'cycles excited', 'reverts', 'unsigned', 'forged')
    )
    assert min(used, bad, excited, unsigned, forged) > 1000
    assert reverts > 20
