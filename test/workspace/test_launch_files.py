"""Launch files parse, start executables that exist, hand on arguments that are declared.

`launch` itself is not to be had without ROS 2: a recording stand-in takes its place.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(ROOT.glob('src/*/launch/*.launch.py'))
MODULES = {
    'launch': ['LaunchDescription'],
    'launch.actions': [
        'DeclareLaunchArgument', 'ExecuteProcess', 'IncludeLaunchDescription',
        'SetEnvironmentVariable',
    ],
    'launch.conditions': ['IfCondition', 'UnlessCondition'],
    'launch.launch_description_sources': ['PythonLaunchDescriptionSource'],
    'launch.substitutions': ['LaunchConfiguration'],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
    'launch_ros.parameter_descriptions': ['ParameterValue'],
    'launch_ros.substitutions': ['ExecutableInPackage'],
}


class Recorded:
    """Any class of `launch`: keeps what it was called with."""

    kind = ''

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


def stand_ins() -> dict[str, ModuleType]:
    modules = {}
    for name, classes in MODULES.items():
        module = modules[name] = ModuleType(name)
        for one in classes:
            setattr(module, one, type(one, (Recorded,), {'kind': one}))
    index = modules['ament_index_python.packages'] = ModuleType('ament_index_python.packages')
    index.get_package_share_directory = lambda package: str(ROOT / 'src' / package)  # type: ignore[attr-defined]
    return modules


def described(path: Path) -> list[Recorded]:
    with mock.patch.dict(sys.modules, stand_ins()):
        found = runpy.run_path(str(path))['generate_launch_description']()
    return list(found.given[0])


def arguments(entries: list[Recorded]) -> dict[str, str]:
    declared = [e for e in entries if e.kind == 'DeclareLaunchArgument']
    return {e.given[0]: e.named['default_value'] for e in declared}


def used(value: Any) -> set[str]:
    """Names of all launch configurations inside `value`."""
    if isinstance(value, Recorded):
        if value.kind == 'LaunchConfiguration':
            return {value.given[0]}
        return used(value.given) | used(value.named)
    if isinstance(value, dict):
        value = value.values()
    inside = isinstance(value, (list, tuple)) or type(value).__name__.startswith('dict_')
    return set().union(*map(used, value)) if inside else set()


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.name)
def test_what_it_uses_starts_and_includes_exists(path: Path) -> None:
    entries = described(path)
    assert used(entries) == set(arguments(entries))
    for node in [e for e in entries if e.kind == 'Node']:
        package, executable = node.named['package'], node.named['executable']
        folder = ROOT / 'src' / package
        assert f"'{executable} = {package}." in (folder / 'setup.py').read_text(encoding='utf-8')
        for given in node.named.get('parameters', []):
            if isinstance(given, dict):
                config = (folder / 'config' / f'{executable}.yaml').read_text(encoding='utf-8')
                known = yaml.safe_load(config)[executable]['ros__parameters']
                source = ''.join(p.read_text(encoding='utf-8') for p in folder.rglob('*.py'))
                assert all(name in known or f"'{name}'" in source for name in given)
    for include in [e for e in entries if e.kind == 'IncludeLaunchDescription']:
        included = Path(include.given[0].given[0])
        assert set(dict(include.named['launch_arguments'])) <= set(arguments(described(included)))
