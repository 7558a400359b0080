"""The source files, each read once: their form, what they import, and what they may call.

Which room may import which is import-linter's (pyproject.toml).
"""

import ast
import importlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from node_process import ended, python

ROOT = Path(__file__).resolve().parents[2]
SRC, TEST = ROOT / 'src', ROOT / 'test'
PACKAGES = [SRC / name / name for name in ('quad_bridge', 'quad_sysid', 'quad_tuning')]
BRIDGE, SYSID, TUNING = PACKAGES
TOO_LONG, GENERATED = 600, 'dialect.py'
pytestmark = pytest.mark.xdist_group('sources')

MESSAGES = {
    'rclpy', 'sensor_msgs', 'geometry_msgs', 'rcl_interfaces', 'diagnostic_msgs', 'std_msgs',
    'std_srvs', 'ament_index_python', 'launch',
}
ROS = MESSAGES | {'quad_bridge', 'serial', 'pymavlink', 'fastcrc'}
SYSTEM_KEYS = {
    'numpy': 'python3-numpy', 'scipy': 'python3-scipy', 'yaml': 'python3-yaml',
    'serial': 'python3-serial', 'matplotlib': 'python3-matplotlib', 'numba': 'python3-numba',
    'rosbags': 'python3-rosbags-pip', 'pymavlink': 'python3-pymavlink-pip',
    'control': 'python-control-pip', 'argcomplete': 'python3-argcomplete',
}  # fmt: skip
"""Imports that rosdep knows (rosdistro, rosdep/python.yaml); others: requirements/."""
KEYS = {
    *MESSAGES, 'builtin_interfaces', 'launch_ros', *(p.name for p in PACKAGES),
    *SYSTEM_KEYS.values(),
}
FILE_CALLS = {
    'open', 'print', 'exit', 'input', 'read_text', 'write_text', 'read_bytes', 'write_bytes',
    'loadtxt', 'savetxt', 'genfromtxt', 'fromfile', 'tofile', 'memmap',
}
COMMANDS = {'cli.py', 'exports.py', 'history.py', 'update_node.py'}
ROOMS = ('signals', 'blackbox', 'model', 'effects', 'estimate', 'discover', 'loop', 'separation')


@cache
def read(path: Path) -> tuple[str, set[str], set[str]]:
    """The docstring of a file, the packages that it imports anywhere, and what it calls."""
    tree, imports, calls = ast.parse(path.read_text()), set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            imports.add(node.module or '')
        elif isinstance(node, ast.Call):
            name = getattr(node.func, 'id', getattr(node.func, 'attr', ''))
            calls.add(name)
            if name == 'importorskip' and isinstance(node.args[0], ast.Constant):
                imports.add(node.args[0].value)
    return ast.get_docstring(tree) or '', {name.partition('.')[0] for name in imports}, calls


def modules(*folders: Path) -> Iterator[tuple[Path, str, set[str], set[str]]]:
    for folder in folders:
        for path in sorted(folder.rglob('*.py') if folder.is_dir() else [folder]):
            yield path, *read(path)


def test_each_module_opens_with_what_it_is_and_is_no_longer_than_a_thought() -> None:
    for path, docstring, *_ in modules(*PACKAGES):
        assert docstring, path
        assert path.stem not in {'utils', 'util', 'helpers', 'helper', 'misc', 'common'}
        assert path.read_text().count('\n') <= TOO_LONG or path.name == GENERATED, path


def test_nothing_of_one_machine_in_the_project() -> None:
    private = re.compile(r'/(?:home|root|Users)/\w+/|' + re.escape(str(ROOT)))
    listed = ended('git', 'ls-files', '-z', cwd=ROOT)
    listed.check_returncode()
    for name in filter(None, listed.stdout.split('\0')):
        if (path := ROOT / name).is_file():
            assert not private.search(path.read_text(errors='replace')), name


def test_maths_calls_nothing_that_touches_files() -> None:
    maths = [SYSID / room for room in ROOMS] + [SYSID / 'record.py']
    maths += [path for path in TUNING.glob('*.py') if path.name not in COMMANDS]
    found = list(modules(*maths))
    assert len(found) > 50
    for path, _, _, calls in found:
        assert not calls & FILE_CALLS, path


def test_what_both_packages_share_is_linked_and_knows_neither() -> None:
    for shared, link in (
        ('log/stored', SYSID / 'bags/stored'), ('craft.py', SYSID / 'craft.py'),
        ('topics.py', SYSID / 'topics.py'), ('one_line.py', SYSID / 'one_line.py'),
        ('autopilots/table.py', SYSID / 'autopilot_table.py'),
        ('gains/table.py', TUNING / 'gain_table.py')):
        source = BRIDGE / shared
        assert link.resolve() == source
        for path, _, imports, _ in modules(source):
            assert not imports & {'quad_bridge', 'quad_sysid'}, path


@pytest.mark.parametrize('package', ['quad_bridge', 'quad_sysid'])
def test_an_error_shows_the_beginning_of_what_it_found(package: str) -> None:
    """quad_tuning raises those of quad_sysid."""
    refused = importlib.import_module(f'{package}.errors').BadInputError
    assert str(refused('gains.json', 'is wrong', 300 * 'a')).endswith(f'found {300 * "a"}')
    line = str(refused('gains.json', 'is wrong', 'two\nlines ' + 10_000 * 'a', 'see docs'))
    assert line.startswith('gains.json: is wrong: found two lines aaa')
    assert line.endswith('a … (10010 characters); see docs')
    assert len(line) < 400


def test_ros_imports_stand_in_the_manifest_and_no_test_imports_rclpy_itself() -> None:
    for package in PACKAGES:
        manifest = ET.parse(package.parent / 'package.xml').getroot()
        declared = {node.text for node in manifest.iter('exec_depend')} | {package.name}
        for path, _, imports, _ in modules(package, package.parent / 'launch'):
            wanted = {SYSTEM_KEYS.get(top, top) for top in imports} & KEYS
            assert wanted <= declared, f'{path}: {wanted - declared}'
    assert {p.name for p, _, imports, _ in modules(TEST) if 'rclpy' in imports} == {'probe.py'}


def test_every_offline_module_imports_without_ros_and_pip_is_asked_for_none() -> None:
    """All of quad_sysid and quad_tuning but the nodes, their parts `x_….py`, and the demo."""
    names = []
    for path, _, imports, _ in modules(SYSID, TUNING):
        inside = path.relative_to(SRC).with_suffix('').parts[1:]
        nodes = tuple(p.stem.removesuffix('node') for p in path.parent.glob('*_node.py'))
        if not path.stem.startswith(nodes or '?') and 'demo' not in inside:
            assert not imports & ROS - {'pymavlink'}, path  # in functions neither
            names.append('.'.join(inside).removesuffix('.__init__'))
    assert len(names) > 100
    source = (f'import sys; sys.modules.update(dict.fromkeys({sorted(ROS)!r}))\n'
              f'for name in {names!r}: __import__(name)')
    done = python('-c', source)
    assert done.returncode == 0, done.stderr
    for package in (SYSID, TUNING):
        text = (package.parent / 'setup.py').read_text()
        asked = text.partition('install_requires=[')[2].partition(']')[0]
        assert asked
        assert not any(name in asked for name in ROS)
