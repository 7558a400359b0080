"""The probe tells what goes over the wire as it was; its end is one failed assertion."""

import ast
import math
import os
import signal
from pathlib import Path

import pytest
from probe import content, entries, event, stamp, stamp_ns

TESTS = Path(__file__).resolve().parents[1]


def imported(tree):
    """The packages that a file imports, in functions too."""
    for node in ast.walk(tree):
        names = [node.module or ''] if isinstance(node, ast.ImportFrom) else []
        names += [one.name for one in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.Call) and getattr(node.func, 'attr', '') == 'importorskip':
            names.append(node.args[0].value)
        yield from (name.partition('.')[0] for name in names)


def test_no_test_imports_rclpy_itself():
    files = {path: ast.parse(path.read_text()) for path in TESTS.rglob('*.py')}
    found = {path.name for path, tree in files.items() if 'rclpy' in imported(tree)}
    assert found == {'probe.py'}


def test_what_is_said_is_heard_with_every_field(probe):
    imu, told = probe.listen('/left/imu/data'), probe.listen('/diagnostics')
    gains = probe.listen('/gains/active')
    probe.meet('/left/imu/data', '/diagnostics')
    covariance = [0.5 * k for k in range(9)]
    probe.publish('/left/imu/data', *(
        {'header': stamp(10**18 + k), 'angular_velocity': {'x': k, 'y': math.nan, 'z': math.inf},
         'angular_velocity_covariance': covariance} for k in range(300)
    ))  # fmt: skip
    values = [{'key': 'a', 'value': 'b'}]
    probe.publish('/diagnostics', {'status': [{'name': 'n', 'level': 2, 'values': values}]})
    wanted = {'one': 1.5, 'two': 'text', 'three': True, 'four': 4}
    probe.publish('/gains/active', event(wanted))
    probe.until(lambda: len(imu) == 300 and told and gains)
    assert [stamp_ns(m) - 10**18 for m in imu] == list(range(300))
    assert [m.angular_velocity.x for m in imu] == list(range(300))
    assert math.isnan(imu[0].angular_velocity.y)
    assert imu[0].angular_velocity.z == math.inf
    assert imu[0].angular_velocity_covariance == covariance
    assert (entries(told)['n'].level, entries(told)['n'].values) == (2, {'a': 'b'})
    assert content(gains[0]) == wanted


def test_services_are_served_and_asked_and_messages_repeated(probe):
    asked = probe.serve('/some/service', 'std_srvs/srv/SetBool', success=True, message='so')
    answer = probe.call('/some/service', 'std_srvs/srv/SetBool', data=True)
    assert (answer.success, answer.message, asked[0].data) == (True, 'so', True)
    heard = probe.listen('/operator/enable')
    probe.publish('/operator/enable', {'data': True}, every_s=0.01)
    probe.until(lambda: len(heard) > 5)
    probe.silence('/operator/enable')
    assert probe.listeners('/operator/enable') == 1
    with pytest.raises(AssertionError, match="KeyError: 'datum'"):
        probe.publish('/operator/enable', {'datum': True})


def test_a_fault_of_the_middleware_is_one_failed_assertion(ros_domain, tmp_path):
    from probe import Probe

    del ros_domain
    probe = Probe(tmp_path)
    probe.nodes()
    os.kill(probe.pid, signal.SIGSEGV)
    with pytest.raises(AssertionError, match='the probe has ended'):
        probe.until(lambda: False)
    assert probe.close() == -signal.SIGSEGV
