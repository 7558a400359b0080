"""The virtual STM32 as a process: time that it owes, readers that it lacks, effects of a user."""

import contextlib
import signal
import time
from itertools import pairwise

import pytest
from flight_controller import Device
from node_process import program

from quad_bridge.virtual.process import main
from quad_bridge.wire import Decoder
from quad_bridge.wire import frames as f


def test_a_stalled_process_catches_up_without_losing_a_cycle(run, tmp_path):
    process = run(*program('virtual_stm32'), '--link', tmp_path / 'tty')
    decoder, cycles = Decoder(), []
    process.until((tmp_path / 'tty').is_symlink)

    def heard(count):
        with contextlib.suppress(BlockingIOError):
            cycles.extend(x for x in decoder.feed(port.read()) if isinstance(x, f.Cycle))
        return len(cycles) >= count

    with contextlib.closing(Device(tmp_path / 'tty')) as port:
        process.until(lambda: heard(50))
        seen = len(cycles)
        process.send(signal.SIGSTOP)
        time.sleep(0.3)  # that it stands still for a while is all that matters
        process.send(signal.SIGCONT)
        process.until(lambda: heard(seen + 200))
    assert process.end() == 0
    steps = {(b.cycle - a.cycle, b.time_us - a.time_us) for a, b in pairwise(cycles)}
    assert all(time_us == 4000 * number for number, time_us in steps)
    # a test that has no CPU for half a second does not read, and is told so
    assert {number for number, _ in steps} == {1} or 'nobody read them' in process.printed
    assert decoder.counts.bad_crc == 0


EFFECT = 'import numpy as np\ndef effect(t_s, rates, angles, thrusts, battery_v):\n    '


@pytest.mark.parametrize(
    ('source', 'said'),
    [
        (EFFECT + 'raise KeyError("x")\n', 'KeyError'),
        (EFFECT + 'return [1.0, 2.0]\n', 'three finite torques'),
        (EFFECT + 'raise SystemExit(5)\n', 'effect() at t = 0.000 s: SystemExit: 5'),
        ('x = 1\n', 'no function effect'), (None, 'not a readable Python file')],
)
def test_a_bad_effect_module_is_one_line_and_status_2(
    tmp_path, monkeypatch, refused, source, said
):
    monkeypatch.setattr(signal, 'signal', lambda *_: None)  # those of this process stay
    path = tmp_path / 'bad.py'
    if source is not None:
        path.write_text(source, encoding='utf-8')
    error = refused(main, '--effect-module', path, '--duration', '0.1')
    assert str(path) in error
    assert said in error
