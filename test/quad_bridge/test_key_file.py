"""The key's file: made for its owner alone, refused in any other state, in one line."""

import sys

import pytest
from node_process import ended

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


KEY = bytes([0xAB, 9, *range(1, 31)])
HEX = KEY.hex().encode()
NO_KEY, ZEROS = 'must hold 64 hexadecimal digits, or 32 raw bytes', 'is all zeros'
FILES = {
    'raw': (KEY, ''), 'raw, white at its ends': (b'\n' + KEY[1:-1] + b' ', ''), 'hex': (HEX, ''),
    'a line of Windows': (HEX + b'\r\n', ''),
    'the most white space': (HEX + b' ' * (4096 - 64), ''), 'empty': (b'', NO_KEY),
    'a digit missing': (HEX[:63] + b'\n', NO_KEY), 'two keys': (HEX + HEX, NO_KEY),
    'a zero byte behind': (HEX + b'\0', NO_KEY), '31 bytes': (KEY[:31], NO_KEY),
    'raw with a line end': (KEY + b'\n', NO_KEY), 'zeros': (bytes(32), ZEROS)}
"""Content of a file, and what is wrong with it: the same in Python and in C."""


def held(folder, data):
    """A file for its owner alone."""
    path = folder / 'key'
    path.write_bytes(data)
    path.chmod(0o400)
    return path


@pytest.mark.parametrize(
    ('data', 'wrong'), [*FILES.values(), (HEX + b' ' * (4096 - 63), NO_KEY)],
    ids=[*FILES, 'too much white space'],
)
def test_what_is_a_key_and_what_is_none(tmp_path, data, wrong):
    path = held(tmp_path, data)
    if wrong:
        with pytest.raises(BadInputError, match=f'^key file {path}: {wrong}.*make_key FILE$'):
            read_key(path)
    else:
        assert read_key(path) in (data, KEY)


def test_the_firmware_takes_the_same_files(tmp_path, firmware):
    for number, (data, _) in enumerate(FILES.values()):
        (tmp_path / str(number)).mkdir()
        held(tmp_path / str(number), data)
    paths = [tmp_path / str(number) / 'key' for number in range(len(FILES))]
    run = ended(firmware('key'), *paths)
    for path, line, (_, wrong) in zip(paths, run.stdout.splitlines(), FILES.values(), strict=True):
        assert line.startswith(wrong) if wrong else line == read_key(path).hex()


@pytest.mark.parametrize('mode', [0o640, 0o604, 0o620, 0o660, 0o644])
def test_a_file_that_others_may_touch_is_refused(tmp_path, mode):
    path = tmp_path / 'key'
    write_key(path)
    path.chmod(mode)
    with pytest.raises(BadInputError, match=rf'{path}.*mode {mode:04o}; chmod 600'):
        read_key(path)


def test_the_command_keeps_what_is_there_and_says_one_line(tmp_path, refused):
    path = tmp_path / 'key'
    assert main([str(path)]) == 0
    before = path.read_bytes()
    assert 'cannot be made' in refused(main, path)
    assert path.read_bytes() == before
    with pytest.raises(BadInputError, match='make_key'):
        read_key(tmp_path / 'nothing')


@pytest.mark.parametrize('stdout', ['>/dev/full', '>&-'])
def test_that_nobody_reads_what_is_said_is_no_fault(tmp_path, stdout):
    line = f'{sys.executable} -m quad_bridge.key_file {tmp_path / "key"} {stdout}'
    run = ended('bash', '-c', line)
    assert (run.returncode, run.stderr, (tmp_path / 'key').exists()) == (0, '', True)
