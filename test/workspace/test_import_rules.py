"""What ARCHITECTURE.md says of the packages and import-linter (pyproject.toml) cannot check.

Maths touches no file, what two packages share is linked, and the analysis runs without ROS.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SYSID = ROOT / 'src/quad_sysid/quad_sysid'
TUNING = ROOT / 'src/quad_tuning/quad_tuning'
ROS = {
    'rclpy', 'quad_bridge', 'sensor_msgs', 'geometry_msgs', 'rcl_interfaces', 'diagnostic_msgs',
    'std_msgs', 'std_srvs', 'ament_index_python', 'launch', 'serial', 'pymavlink', 'fastcrc',
}
COMMANDS = {'cli.py', 'exports.py', 'history.py', 'update_node.py'}
FILE_CALLS = {
    'open', 'print', 'exit', 'input', 'read_text', 'write_text', 'read_bytes', 'write_bytes',
    'loadtxt', 'savetxt', 'genfromtxt', 'fromfile', 'tofile', 'memmap',
}
ROOMS = ('signals', 'blackbox', 'model', 'effects', 'estimate', 'discover', 'loop', 'separation')


def imports(path: Path) -> set[str]:
    """Packages that a module imports, wherever in it the import stands."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        found += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.append(node.module or '')
    return {name.split('.')[0] for name in found}


def test_maths_calls_nothing_that_touches_files() -> None:
    files = [path for room in ROOMS for path in (SYSID / room).rglob('*.py')]
    files += [SYSID / 'record.py', *(p for p in TUNING.glob('*.py') if p.name not in COMMANDS)]
    assert len(files) > 50
    for path in files:
        tree = ast.parse(path.read_text())
        calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        names = {getattr(call, 'id', getattr(call, 'attr', '')) for call in calls}
        assert not names & FILE_CALLS, path


@pytest.mark.parametrize(('shared', 'link'), [
    ('log/stored', SYSID / 'bags/stored'), ('gains/motor_places.py', SYSID / 'motor_places.py'),
    ('gains/table.py', TUNING / 'gain_table.py'),
])
def test_what_both_packages_share_is_linked_and_knows_neither(shared: str, link: Path) -> None:
    source = ROOT / 'src/quad_bridge/quad_bridge' / shared
    assert link.resolve() == source
    for path in source.glob('*.py') if source.is_dir() else [source]:
        assert not imports(path) & {'quad_bridge', 'quad_sysid'}, path


def test_every_offline_module_imports_without_ros() -> None:
    """All of quad_sysid and quad_tuning but the nodes, their parts `x_….py`, and the demo."""
    modules = []
    for package in (SYSID, TUNING):
        for path in sorted(package.rglob('*.py')):
            inside = path.relative_to(package.parent).with_suffix('')
            nodes = tuple(p.stem.removesuffix('node') for p in path.parent.glob('*_node.py'))
            if not path.stem.startswith(nodes or '?') and 'demo' not in inside.parts:
                assert not imports(path) & ROS - {'pymavlink'}, path  # in functions neither
                modules.append('.'.join(inside.parts).removesuffix('.__init__'))
    assert len(modules) > 100
    source = (f'import sys; sys.modules.update(dict.fromkeys({sorted(ROS)!r}))\n'
              f'for name in {modules!r}: __import__(name)')
    done = subprocess.run(
        [sys.executable, '-c', source], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_nothing_of_ros_is_asked_of_pip() -> None:
    for package in ('quad_sysid', 'quad_tuning'):
        text = (ROOT / 'src' / package / 'setup.py').read_text()
        asked = text.partition('install_requires=[')[2].partition(']')[0]
        assert asked
        assert not any(name in asked for name in ROS)
