"""What a user's effect or Ctrl-C must not do to the virtual STM32: end it without a line."""

import numpy as np
import pytest

from quad_bridge.virtual import process
from quad_bridge.virtual.effect_module import load_effect
from quad_bridge.virtual.errors import EffectModuleError


def test_an_effect_that_exits_is_named(tmp_path):
    file = tmp_path / 'leaves.py'
    file.write_text('import sys\nsys.exit(3)\n')
    with pytest.raises(EffectModuleError, match=r'leaves\.py.*SystemExit: 3'):
        load_effect(file)
    file.write_text('def effect(*given):\n    raise SystemExit(5)\n')
    with pytest.raises(EffectModuleError, match=r'effect\(\) at t = 0\.5.*SystemExit: 5'):
        load_effect(file)(0.5, np.zeros(3), np.zeros(3), np.zeros(4), 12.0)


def test_an_interrupt_while_it_prepares_is_one_line(capsys, monkeypatch):
    def interrupted(*_given, **_named):
        raise KeyboardInterrupt

    monkeypatch.setattr(process, '_warm_up', interrupted)
    assert process.main([]) == 130
    assert capsys.readouterr().err == 'virtual_stm32: interrupted\n'
