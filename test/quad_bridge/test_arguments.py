"""Wrong arguments of this package's programs are said in one line, status 2."""

import pytest

from quad_bridge.recover import main as recover
from quad_bridge.virtual.process import main as virtual_stm32


@pytest.mark.parametrize(
    ('program', 'arguments', 'words'),
    [
        (recover, [], 'recover: the following arguments are required: BAG'),
        (virtual_stm32, ['--mount', 'kite'], 'virtual_stm32: argument --mount: invalid choice'),
        (virtual_stm32, ['--sede', '1'], 'virtual_stm32: unrecognized arguments: --sede'),
        (virtual_stm32, ['--seed', '-1'], '--seed: must be a whole number of 0 or more'),
        (virtual_stm32, ['--duration', 'nan'], '--duration: must be a number above 0'),
        (virtual_stm32, ['--duration', 'inf'], '--duration: must be a number above 0'),
        (virtual_stm32, ['--duration', '-1'], '--duration: must be a number above 0'),
        (virtual_stm32, ['--duration', 'long'], "must be a number above 0, found 'long'"),
    ],
)
def test_wrong_arguments(capsys, program, arguments, words):
    with pytest.raises(SystemExit) as left:
        program(arguments)
    error = capsys.readouterr().err
    assert (left.value.code, error.count('\n')) == (2, 1)
    assert words in error
