"""The workspace as ROS 2 sees it: package kinds, entry points, manifests."""

import ast
import configparser
import contextlib
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock
from xml.etree import ElementTree as ET

import pytest

import quad_sysid

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ('quad_bridge', 'quad_sysid', 'quad_tuning')
NEEDED, RUN = ('quad_firmware', 'quad_bridge'), 'run quad_bridge virtual_stm32 --duration 1'


def setup_arguments(package: str, command: str = 'develop') -> dict[str, Any]:
    """What the setup.py of a package hands to setuptools when called with `command`."""
    folder = ROOT / 'src' / package
    with (
        mock.patch('setuptools.setup') as setup,
        mock.patch.object(sys, 'argv', ['setup.py', command]),
        contextlib.chdir(folder) if sys.version_info >= (3, 11) else contextlib.nullcontext(),
    ):
        runpy.run_path(str(folder / 'setup.py'))
    return dict(setup.call_args.kwargs)


@pytest.mark.long
def test_colcon_builds_the_firmware_in_any_workspace(tmp_path: Path) -> None:
    """A checkout in a fresh workspace: its virtual STM32 flies the firmware built there."""
    clone = tmp_path / 'src/quad_suite'
    subprocess.run(['git', 'clone', '--quiet', ROOT, clone], check=True)
    build = [sys.executable, '-m', 'colcon', 'build', '--packages-select', *NEEDED]
    environment = {**os.environ, 'AMENT_PREFIX_PATH': sys.prefix}
    for name in ('COLCON_PREFIX_PATH', 'PYTHONPATH'):
        environment.pop(name, None)
    subprocess.run(build, cwd=tmp_path, env=environment, capture_output=True, check=True)
    built = tmp_path / 'install/quad_firmware/lib/quad_firmware'
    ros2 = shlex.join([sys.executable, str(ROOT / 'tools/ros2_stand_in.py')])
    flown = subprocess.run(
        ['bash', '-c', f'. install/local_setup.bash; {ros2} {RUN}'],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (built / 'quad_firmware').is_file()
    assert (flown.returncode, flown.stderr) == (0, '')
    assert 'virtual STM32 on /dev/pts/' in flown.stdout


@pytest.mark.parametrize('package', PACKAGES)
def test_manifest_and_setup_agree_and_every_entry_point_leads_to_a_function(package: str) -> None:
    manifest = ET.parse(ROOT / 'src' / package / 'package.xml').getroot()
    arguments = setup_arguments(package)
    assert (manifest.get('format'), manifest.findtext('name')) == ('3', package)
    for name in ('version', 'license'):
        assert arguments[name] == manifest.findtext(name)
        assert f'{name}: {manifest.findtext(name)}\n' in (ROOT / 'CITATION.cff').read_text()
    newest = re.search(r'^## (.*)', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)
    assert newest[1] == manifest.findtext('version')
    if package == 'quad_sysid':
        assert quad_sysid.__version__ == newest[1]
    for line in (line for lines in arguments['entry_points'].values() for line in lines):
        module, function = line.split('=')[1].strip().split(':')
        path = ROOT / 'src' / module.split('.')[0] / (module.replace('.', '/') + '.py')
        if not path.exists():
            path = path.with_suffix('') / '__init__.py'
        names = {getattr(node, 'name', '') for node in ast.parse(path.read_text()).body}
        assert function in names, line


@pytest.mark.parametrize(
    ('package', 'command'), [('quad_sysid', 'quad-sysid'), ('quad_tuning', 'quad-tune')]
)
def test_pip_puts_one_command_on_the_path(package: str, command: str) -> None:
    """Names such as `identify` and `import` are other programs' there; `ros2 run` has them."""
    scripts = setup_arguments(package, 'bdist_wheel')['entry_points']['console_scripts']
    assert [line.split(' = ')[0] for line in scripts] == [command]
    assert len(setup_arguments(package)['entry_points']['console_scripts']) > 1


def test_colcon_runs_every_folder_of_tests_once() -> None:
    named: list[Path] = []
    for package in PACKAGES:
        folder = ROOT / 'src' / package
        setup = configparser.ConfigParser()
        setup.read(folder / 'setup.cfg')
        assert '--import-mode=importlib' in setup['tool:pytest']['addopts']
        paths = [(folder / p).resolve() for p in setup['tool:pytest']['testpaths'].split()]
        assert ROOT / 'test' / package in paths
        named += paths
    there = [p for p in (ROOT / 'test').iterdir() if any(p.glob('test_*.py'))]
    assert sorted(named) == sorted(there)
