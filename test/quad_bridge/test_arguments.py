"""Wrong arguments of this package's programs are one line, status 2; a full disk is no fault."""

import subprocess
import sys
from pathlib import Path

import pytest

from quad_bridge.arguments import ended_in_one_line
from quad_bridge.log.recover import main as recover
from quad_bridge.virtual.process import main as virtual_stm32


@pytest.mark.parametrize(
    ('program', 'arguments', 'words'),
    [
        (recover, [], 'recover: the following arguments are required: BAG'),
        (virtual_stm32, ['--mount', 'kite'], 'virtual_stm32: argument --mount: invalid choice'),
        (virtual_stm32, ['--sede', '1'], 'virtual_stm32: unrecognized arguments: --sede'),
        (virtual_stm32, ['--seed', '-1'], '--seed: must be a whole number of 0 or more'),
        (virtual_stm32, ['--duration', 'nan'], '--duration: must be a number above 0'),
        (virtual_stm32, ['--duration', 'long'], "must be a number above 0, found 'long'"),
    ],
)
def test_wrong_arguments(capsys, program, arguments, words):
    with pytest.raises(SystemExit) as left:
        program(arguments)
    error = capsys.readouterr().err
    assert (left.value.code, error.count('\n')) == (2, 1)
    assert words in error


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


def test_what_the_disk_refuses_is_one_line(capsys):
    with pytest.raises(SystemExit) as left:
        ended_in_one_line('recover', lambda: Path('/').write_text('x'))
    assert left.value.code == 2
    assert capsys.readouterr().err == 'recover: /: Is a directory\n'
