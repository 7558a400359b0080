"""The workspace as ROS 2 sees it: package kinds, entry points, manifests."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ('quad_bridge', 'quad_sysid', 'quad_tuning')


def setup_arguments(package: str) -> dict[str, ast.expr]:
    """Keyword arguments of the setup() call of a package, unevaluated."""
    tree = ast.parse((ROOT / 'src' / package / 'setup.py').read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'setup':
            return {k.arg: k.value for k in node.keywords if k.arg}
    raise AssertionError(package)


def entry_points(package: str) -> list[str]:
    """Every `name = module:function` string in the setup.py of a package."""
    text = ast.parse((ROOT / 'src' / package / 'setup.py').read_text())
    return [
        node.value
        for node in ast.walk(text)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        and '=' in node.value and ':' in node.value and node.value.count('=') == 1
        and '>' not in node.value
    ]  # fmt: skip


def test_colcon_takes_all_three_for_ament_python() -> None:
    if importlib.util.find_spec('colcon_ros') is None:
        pytest.skip('colcon-ros is not installed')
    listed = subprocess.run(
        [sys.executable, '-m', 'colcon', '--log-base', '/dev/null', 'list', '--base-paths', 'src'],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    kinds = {line.split()[0]: line.split()[-1] for line in listed.splitlines() if line.strip()}
    assert kinds == dict.fromkeys(PACKAGES, '(ros.ament_python)')


@pytest.mark.parametrize('package', PACKAGES)
def test_manifest_and_setup_agree(package: str) -> None:
    manifest = ET.parse(ROOT / 'src' / package / 'package.xml').getroot()
    assert manifest.get('format') == '3'
    assert manifest.findtext('name') == package
    assert manifest.findtext('export/build_type') == 'ament_python'
    arguments = setup_arguments(package)
    assert ast.literal_eval(arguments['version']) == manifest.findtext('version')
    assert ast.literal_eval(arguments['license']) == manifest.findtext('license')
    assert (ROOT / 'src' / package / 'resource' / package).exists()


@pytest.mark.parametrize('package', PACKAGES)
def test_every_entry_point_leads_to_a_function(package: str) -> None:
    for line in entry_points(package):
        module, function = line.split('=')[1].strip().split(':')
        path = ROOT / 'src' / module.split('.')[0] / (module.replace('.', '/') + '.py')
        if not path.exists():
            path = path.with_suffix('') / '__init__.py'
        assert path.exists(), line
        names = {
            node.name
            for node in ast.parse(path.read_text()).body
            if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        assert function in names, line


@pytest.mark.parametrize('package', PACKAGES)
def test_ros_imports_stand_in_the_manifest(package: str) -> None:
    manifest = ET.parse(ROOT / 'src' / package / 'package.xml').getroot()
    declared = {node.text for node in manifest.iter('exec_depend')} | {package}
    ros = {
        'rclpy', 'sensor_msgs', 'geometry_msgs', 'rcl_interfaces', 'diagnostic_msgs', 'std_msgs',
        'std_srvs', 'builtin_interfaces', 'ament_index_python', *PACKAGES,
    }  # fmt: skip
    for path in (ROOT / 'src' / package / package).rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                tops = {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                tops = {node.module.split('.')[0]}
            else:
                continue
            assert tops & ros <= declared, f'{path}: {tops & ros - declared}'
