"""The rules of ARCHITECTURE.md about who may import what, and that the analysis needs no ROS.

What import-linter's contracts (pyproject.toml) say, `make lint` checks; here stands what it cannot
check: standard modules and calls that touch files.
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
OUTSIDE_MATHS = ROS | {
    'matplotlib', 'rosbags', 'socket', 'subprocess', 'sqlite3', 'io', 'csv', 'json', 'yaml',
    'pickle', 'shutil', 'tempfile', 'argparse', 'logging',
}
PORTS = {'serial', 'rclpy', 'socket', 'select', 'termios', 'fcntl'}
FILE_CALLS = {
    'open', 'print', 'exit', 'input', 'read_text', 'write_text', 'read_bytes', 'write_bytes',
    'loadtxt', 'savetxt', 'genfromtxt', 'fromfile', 'tofile', 'memmap',
}
ROOMS = ('signals', 'blackbox', 'model', 'effects', 'estimate', 'discover', 'loop', 'separation')


def maths_files() -> list[Path]:
    """Every module of the packages that must stay free of ROS, serial, plotting and I/O."""
    files = [SYSID / name for name in ('record.py', 'contract.py', 'errors.py')]
    files += [path for room in ROOMS for path in sorted((SYSID / room).rglob('*.py'))]
    orchestration = {'demo', 'report', 'history', 'cli.py'}
    return files + [
        path for path in sorted(TUNING.rglob('*.py'))
        if not orchestration & {path.relative_to(TUNING).parts[0], path.name}
    ]


def imports(path: Path | str) -> set[str]:
    """Packages that a module, or source text, imports, wherever in it the import stands."""
    found = []
    for node in ast.walk(ast.parse(path if isinstance(path, str) else path.read_text())):
        found += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.append(node.module or '')
    return {name.split('.')[0] for name in found}


def offences(source: str) -> list[str]:
    """What a maths module must not do: imports of the outside, calls that touch files."""
    calls = [node.func for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    names = {getattr(call, 'id', getattr(call, 'attr', '')) for call in calls}
    return sorted(imports(source) & OUTSIDE_MATHS | names & FILE_CALLS)


def test_maths_touches_neither_ros_nor_files_and_wire_no_port() -> None:
    files = maths_files()
    assert len(files) > 50
    for path in files:
        assert offences(path.read_text()) == [], path
    for path in (ROOT / 'src/quad_bridge/quad_bridge/wire').rglob('*.py'):
        assert not imports(path) & PORTS, path


@pytest.mark.parametrize(('shared', 'link'), [
    ('log/stored', 'bags/stored'), ('gains/motor_places.py', 'motor_places.py'),
])
def test_what_both_packages_share_is_linked_and_knows_neither(shared: str, link: str) -> None:
    source = ROOT / 'src/quad_bridge/quad_bridge' / shared
    assert (ROOT / 'src/quad_sysid/quad_sysid' / link).resolve() == source
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


@pytest.mark.parametrize('package', ['quad_sysid', 'quad_tuning'])
def test_nothing_of_ros_is_asked_of_pip(package: str) -> None:
    text = (ROOT / 'src' / package / 'setup.py').read_text()
    asked = text.partition('install_requires=[')[2].partition(']')[0]
    assert not any(name in asked for name in ROS)
