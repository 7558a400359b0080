"""The observer hears the state topics, also the words that were said before it came."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import pytest
from node_process import Started
from probe import Probe, event

WATCH = """
import json, os
from quad_tuning.demo.errors import StageFailedError
from quad_tuning.demo.observer import Observer

with Observer(int(os.environ['ROS_DOMAIN_ID'])) as observer:
    try:
        observer.wait_for('connect', {what!r}, lambda: {condition}, {seconds})
        {then}
        failed = ''
    except StageFailedError as error:
        failed = str(error)
    print(json.dumps([observer.active_gains, observer.bag, failed]))
"""


@pytest.fixture
def observe(run: Callable[..., Started]) -> Callable[..., list[Any]]:
    """What an observer, as a process, has heard: gains, bag, and why it failed."""

    def watch(condition: str, then: str = 'pass', what: str = 'word', seconds: float = 200.0):
        words = WATCH.format(what=what, condition=condition, then=then, seconds=seconds)
        observer = run(sys.executable, '-c', words)
        assert observer.wait() == 0, observer.said
        return json.loads(observer.printed)

    return watch


def test_late_it_still_hears_the_last_gains_and_the_bag(probe: Probe, observe) -> None:
    probe.publish('/gains/active', event({'roll.kp': 3.0, 'source': 'read back'}))
    probe.publish('/logger/bag', event({'path': 'flight_1', 'split': 2, 'whole': True}))
    gains, bag, failed = observe('observer.active_gains and observer.bag')
    assert (gains, failed) == ({'roll.kp': 3.0}, '')
    assert bag == {'path': 'flight_1', 'split': 2, 'whole': True}


def test_silence_ends_with_what_the_nodes_complain_of(probe: Probe, observe) -> None:
    status = {'level': 2, 'name': 'link', 'message': 'port is busy'}
    probe.publish('/diagnostics', {'status': [status]}, every_s=0.1)
    then = "observer.wait_for('connect', 'gains', lambda: False, 0.3)"
    *_, failed = observe('observer.diagnostics', then)
    assert failed.startswith('connect: no gains within 0 s (')
    assert 'port is busy' in failed


def test_a_refused_call_gives_the_reason(probe: Probe, observe) -> None:
    probe.serve('/bag_logger/start', success=False, message='disk is full')
    *_, failed = observe('True', "observer.call('fly', '/bag_logger/start', 200.0)")
    assert failed == 'fly: /bag_logger/start: disk is full'
