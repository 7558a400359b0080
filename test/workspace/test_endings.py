"""Every node, every way of ending: status 0 or the documented one, and never a traceback."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from node_process import STARTS, Started, node_command, program
from probe import Probe, content, entries, event

INT, TERM = signal.SIGINT, signal.SIGTERM
NODES = {
    'serial_bridge': ('quad_bridge.nodes.serial_bridge', 'SerialBridge', '_on_report'),
    'bag_logger': ('quad_bridge.nodes.bag_logger', 'BagLogger', '_on_report'),
    'monitor': ('quad_bridge.nodes.monitor', 'Monitor', '_look'),
    'excitation': ('quad_sysid.excitation_node', 'ExcitationNode', '_report'),
    'identification': ('quad_sysid.identification_node', 'IdentificationNode', '_collect'),
}
"""Module, class, and a callback that a timer calls."""
assert {*NODES, 'virtual_stm32'} == set(STARTS)
ONE_OF_EACH = ('serial_bridge', 'excitation', 'virtual_stm32')
"""The nodes of a package begin by the same lines."""
PARAMETERS = {
    'serial_bridge': {'port': 'tty', 'state_folder': 'state'},
    'bag_logger': {'autostart': True},
}
INTERRUPT_AT_IMPORT = """
import importlib.abc, os, sys
class Interrupt(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {0!r}:
            os.kill(os.getpid(), {1})
sys.meta_path.insert(0, Interrupt())
"""
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
module.{1}.{2} = fail
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
    process = begin(name, INTERRUPT_AT_IMPORT.format(module, int(number)), fresh=True)
    assert ended(process, 0 if name in NODES else 130) == ''


@pytest.mark.parametrize('name', NODES)
def test_a_callback_that_fails_is_said_and_the_node_goes_on(begin, name):
    process = begin(name, FAIL.format(*NODES[name]))
    process.says('a callback failed and was left out: OverflowError: too large')
    process.send(INT)
    assert ended(process).count('OverflowError') == 1


@pytest.mark.parametrize('name', ONE_OF_EACH)
def test_nobody_reads_what_it_says(begin, name):
    """As behind `| head`, or in a terminal that is gone."""
    reading, writing = os.pipe()
    os.close(reading)
    process = begin(name, SAY_READY * (name in NODES), stdout=writing, stderr=writing)
    os.close(writing)
    process.until(Path('ready').exists)
    process.send(TERM)
    ended(process)


@pytest.mark.parametrize('name', STARTS)
def test_more_than_one_signal_and_no_standard_streams(begin, name):
    process = begin(name, SAY_READY * (name in NODES), 'exec "$@" <&- >&- 2>&-')
    process.until(Path('ready').exists)
    for number in range(3):  # else a port or a bag could get what ROS logs
        assert str(Path(f'/proc/{process.pid}/fd/{number}').readlink()) == os.devnull
    for number in (INT, INT, TERM):
        process.send(number)
    ended(process)


def test_a_recording_ends_with_its_node(begin, probe):
    told = probe.listen('/logger/bag')
    process = begin('bag_logger')
    probe.until(lambda: told)
    process.send(TERM)
    ended(process)
    probe.until(lambda: len(told) == 2)
    bag = Path(content(told[1])['path'])
    assert (content(told[1])['state'], (bag / 'metadata.yaml').exists()) == ('complete', True)


def test_an_identification_that_still_computes_is_not_waited_for(begin, probe):
    compute = """
import quad_sysid.session as session
def run(*_):
    while True:
        sum(range(100_000))
session.run = run
"""
    process = begin('identification', compute)
    told = probe.listen('/diagnostics')
    probe.publish('/logger/bag', event({'path': '/some/bag', 'state': 'complete'}))
    name = 'identification: identification'
    probe.until(lambda: 'identifying' in getattr(entries(told).get(name), 'message', ''))
    process.send(INT)
    ended(process)


def test_a_fault_of_the_middleware_is_one_failed_assertion(ros_domain, tmp_path, nursery):
    del ros_domain
    probe = Probe(tmp_path, nursery)
    probe.nodes()
    os.kill(probe.pid, signal.SIGSEGV)
    with pytest.raises(AssertionError, match='the probe has ended'):
        probe.until(lambda: False)
    assert probe.close() == -signal.SIGSEGV
