"""The key's file: made for its owner alone, refused in any other state, in one line."""

import subprocess
import sys

import pytest

from quad_bridge.errors import BadInputError
from quad_bridge.key_file import main, read_key, signing_from, write_key


def test_a_key_that_was_made_is_read(tmp_path):
    path = tmp_path / 'key'
    write_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(read_key(path)) == 32
    assert signing_from(path).key == read_key(path)
    assert signing_from(None) is None
    write_key(tmp_path / 'second')
    assert read_key(tmp_path / 'second') != read_key(path)


@pytest.mark.parametrize('data', [bytes(range(32)), bytes(range(32)).hex().encode() + b'\r\n'])
def test_raw_or_hexadecimal(tmp_path, data):
    path = tmp_path / 'key'
    path.write_bytes(data)
    path.chmod(0o400)
    assert read_key(path) == bytes(range(32))


@pytest.mark.parametrize('mode', [0o640, 0o604, 0o620, 0o660, 0o644])
def test_a_file_that_others_may_touch_is_refused(tmp_path, mode):
    path = tmp_path / 'key'
    write_key(path)
    path.chmod(mode)
    with pytest.raises(BadInputError, match=rf'{path}.*mode {mode:04o}; chmod 600'):
        read_key(path)


@pytest.mark.parametrize('data', [b'', b'12ab', bytes(31), bytes(33), b'x' * 64, b'00' * 33])
def test_what_is_no_key_is_refused(tmp_path, data):
    path = tmp_path / 'key'
    path.write_bytes(data)
    path.chmod(0o600)
    with pytest.raises(BadInputError, match='64 hexadecimal digits'):
        read_key(path)


def test_the_command_keeps_what_is_there_and_says_one_line(tmp_path, capsys):
    path = tmp_path / 'key'
    assert main([str(path)]) == 0
    before = path.read_bytes()
    capsys.readouterr()
    assert main([str(path)]) == 2
    error = capsys.readouterr().err
    assert (error.count('\n'), 'cannot be made' in error) == (1, True)
    assert path.read_bytes() == before
    with pytest.raises(BadInputError, match='make_key'):
        read_key(tmp_path / 'nothing')


def test_the_virtual_stm32_refuses_a_readable_key(tmp_path):
    path = tmp_path / 'key'
    write_key(path)
    path.chmod(0o644)
    start = 'import sys; from quad_bridge.virtual.process import main; sys.exit(main())'
    run = subprocess.run(
        [sys.executable, '-c', start, '--key', str(path)],
        capture_output=True, text=True, check=False,
    )
    assert (run.returncode, run.stderr.count('\n')) == (2, 1)
    assert 'chmod 600' in run.stderr
