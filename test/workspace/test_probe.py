"""The probe tells what goes over the wire as it was; its end is one failed assertion."""

import ast
import os
import signal
from pathlib import Path

import pytest

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


def test_a_fault_of_the_middleware_is_one_failed_assertion(ros_domain, tmp_path):
    from probe import Probe

    del ros_domain
    probe = Probe(tmp_path)
    probe.nodes()
    os.kill(probe.pid, signal.SIGSEGV)
    with pytest.raises(AssertionError, match='the probe has ended'):
        probe.until(lambda: False)
    assert probe.close() == -signal.SIGSEGV
