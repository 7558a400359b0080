"""The analysis and the design work on a machine without ROS and without quad_bridge."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ABSENT = (
    'rclpy', 'quad_bridge', 'sensor_msgs', 'geometry_msgs', 'rcl_interfaces', 'diagnostic_msgs',
    'std_srvs', 'ament_index_python', 'serial', 'pymavlink', 'fastcrc',
)  # fmt: skip


def offline_modules() -> list[str]:
    """Every module of quad_sysid and quad_tuning but the nodes, their parameters and the demo."""
    names = []
    for package in ('quad_sysid', 'quad_tuning'):
        root = ROOT / 'src' / package
        for path in sorted((root / package).rglob('*.py')):
            inside = path.relative_to(root)
            nodes = {p.stem.removesuffix('_node') for p in path.parent.glob('*_node.py')}
            of_a_node = any(path.stem.startswith(f'{name}_') for name in nodes)
            if not of_a_node and 'demo' not in inside.parts:
                names.append('.'.join(inside.with_suffix('').parts).removesuffix('.__init__'))
    return names


def test_every_offline_module_imports_without_ros() -> None:
    block = f'import sys; sys.modules.update(dict.fromkeys({ABSENT!r}))'
    modules = [name for name in offline_modules() if not name.endswith('__main__')]
    source = f'{block}\nfor name in {modules!r}: __import__(name)'
    done = subprocess.run(
        [sys.executable, '-c', source], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize('package', ['quad_sysid', 'quad_tuning'])
def test_nothing_of_ros_is_asked_of_pip(package: str) -> None:
    text = (ROOT / 'src' / package / 'setup.py').read_text()
    asked = text.partition('install_requires=[')[2].partition(']')[0]
    assert not any(name in asked for name in ABSENT)
