"""Every node, every way of ending: status 0 or the documented one, and never a traceback."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from node_process import PROGRAMS, SIGNAL_AT_IMPORT, Started, node_command, program
from probe import event

INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
NODES = {*PROGRAMS} - {'virtual_stm32', 'main'}
ONE_OF_EACH = ('serial_bridge', 'excitation', 'virtual_stm32')
"""The nodes of a package begin by the same lines."""
PARAMETERS = {
    'serial_bridge': {'port': 'tty', 'state_folder': 'state'}, 'bag_logger': {'autostart': True}}
SAY_READY = """
import pathlib
from rclpy.executors import SingleThreadedExecutor as E
spin_once = E.spin_once
E.spin_once = lambda *a, **b: (pathlib.Path('ready').touch(), spin_once(*a, **b))
"""
FAIL = """
import {0} as module
def fail(*_given):
    raise OverflowError('too large')
module.{1} = fail
"""


@pytest.fixture
def begin(run, tmp_path, monkeypatch, request) -> Callable[..., Started]:
    """A function that starts any of them in a folder of its own, `before` in its process first."""
    monkeypatch.chdir(tmp_path)

    def begin(name: str, before: str = '', shell: str = '', **options: object) -> Started:
        if name in NODES:
            request.getfixturevalue('ros')
            command = node_command(name, broken=before, **PARAMETERS.get(name, {}))
        else:
            command = [*program(name, before), '--link', 'ready']
        return run(*(['sh', '-c', shell, 'sh'] if shell else []), *command, **options)

    return begin


def ended(process: Started, status: int = 0) -> str:
    """What it has said; nothing of its own fault."""
    assert process.wait() == status, process.said
    assert 'Traceback' not in process.said
    return process.said


@pytest.mark.parametrize(
    ('name', 'number'), [('serial_bridge', INT), ('excitation', TERM), ('virtual_stm32', INT)]
)
def test_a_signal_while_it_imports(begin, name, number):
    last = 'rclpy.executors' if name in NODES else 'quad_bridge.virtual.receiver'
    module = 'numpy' if number == INT else last
    process = begin(name, SIGNAL_AT_IMPORT.format(module, int(number)), fresh=True)
    assert ended(process, 0 if name in NODES else 130) == ''


def test_a_callback_that_fails_is_said_and_only_signals_end_the_node(begin):
    """One that a timer calls; the excitation's ends what it flies (test_excitation_node.py)."""
    process = begin('serial_bridge', FAIL.format(PROGRAMS['serial_bridge'][1],
                                                 'SerialBridge._on_report'))
    process.says('a callback failed and was left out: OverflowError: too large')
    for number in (INT, INT, TERM):
        process.send(number)
    assert ended(process).count('OverflowError') == 1


@pytest.mark.parametrize('name', ONE_OF_EACH)
def test_no_standard_streams_or_nobody_who_reads_them(begin, name):
    """As behind `| head`, or in a terminal that is gone."""
    reading, writing = os.pipe()
    os.close(reading)
    ready, before = Path('ready'), SAY_READY * (name in NODES)
    deaf = begin(name, before, stdout=writing, stderr=writing)
    os.close(writing)
    deaf.until(ready.exists)
    deaf.send(HUP if name in NODES else TERM)
    ended(deaf)
    ready.unlink(missing_ok=True)
    without = begin(name, before, 'exec "$@" <&- >&- 2>&-')
    without.until(ready.exists)
    for number in range(3):  # else a port or a bag could get what ROS logs
        assert str(Path(f'/proc/{without.pid}/fd/{number}').readlink()) == os.devnull
    for number in (INT, INT, TERM):
        without.send(number)
    ended(without)


def test_an_identification_that_still_computes_is_not_waited_for(begin, probe):
    compute = """
import quad_sysid.session as session
def run(bags, folder, wanted, progress):
    progress('roll: what is missing')
    while True:
        sum(range(100_000))
session.run = run
"""
    process = begin('identification', compute)
    probe.listen('/diagnostics')
    probe.publish('/logger/bag', event({'path': str(Path('bag').resolve()), 'state': 'complete'}))
    name = 'identification: identification'
    line = 'identifying: roll: what is missing'
    probe.until(lambda: probe.diagnostics(name) == line)
    process.send(INT)
    ended(process)
