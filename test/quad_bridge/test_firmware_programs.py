"""The firmware's own test programs (firmware/test), one of them on a model of registers."""

import platform
import re
import subprocess

import pytest
from probe import PATIENCE_S

PC = pytest.mark.skipif(platform.machine() != 'x86_64', reason='its registers lie on x86-64 only')


@pytest.mark.parametrize(
    ('target', 'says', 'least'),
    [
        ('store', r'(\d+) cuts', 5000),
        ('chips', r'(\d+) checks, 0 failed', 400),
        pytest.param('registers', r'(\d+) cuts between accesses', 500, marks=PC),
    ],
)
def test_it_ends_well(firmware, target, says, least):
    """Power cuts at every byte of a flash write; drivers by their datasheets; DMA, I2C, flash."""
    run = subprocess.run(
        [firmware(target)], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (run.returncode, run.stderr) == (0, ''), run.stdout
    assert int(re.search(says, run.stdout)[1]) > least
