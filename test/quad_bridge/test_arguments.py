"""Wrong arguments of this package's programs are one line, status 2; a full disk is no fault."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ('program', 'stdout'),
    [
        ('key_file', '>/dev/full'),
        ('key_file', '>&-'),
        ('virtual.process', '>/dev/full'),
    ],
)
def test_that_nobody_reads_what_is_said_is_no_fault(tmp_path, program, stdout):
    key = tmp_path / 'key'
    given = f'--duration 0.02 --link {key}' if program == 'virtual.process' else key
    line = f'set -o pipefail; {sys.executable} -m quad_bridge.{program} {given} {stdout}'
    run = subprocess.run(['bash', '-c', line], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, '')
    assert key.exists() == (program == 'key_file')
