"""The rules of ARCHITECTURE.md about who may import what, on the source text.

Direct imports by room stand here; transitive ones are import-linter's (pyproject.toml), which
`make lint` and the last test run.
"""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SYSID = ROOT / 'src/quad_sysid/quad_sysid'
TUNING = ROOT / 'src/quad_tuning/quad_tuning'
BRIDGE = ROOT / 'src/quad_bridge/quad_bridge'

OUTSIDE_MATHS = {
    'rclpy', 'serial', 'matplotlib', 'rosbags', 'pymavlink', 'sensor_msgs', 'geometry_msgs',
    'rcl_interfaces', 'diagnostic_msgs', 'std_msgs', 'std_srvs', 'ament_index_python', 'launch',
    'socket', 'subprocess', 'sqlite3', 'io', 'csv', 'json', 'yaml', 'pickle', 'shutil', 'tempfile',
    'argparse', 'logging', 'quad_bridge',
}  # fmt: skip
FILE_CALLS = {
    'open', 'print', 'exit', 'input', 'read_text', 'write_text', 'read_bytes', 'write_bytes',
    'loadtxt', 'savetxt', 'genfromtxt', 'fromfile', 'tofile', 'memmap',
}  # fmt: skip
ORCHESTRATION = {'demo', 'report', 'history', 'cli.py'}


def maths_files() -> list[Path]:
    """Every module of the rooms that must stay free of ROS, serial, plotting and I/O."""
    files = [SYSID / name for name in ('record.py', 'contract.py', 'errors.py')]
    for room in (
        'signals', 'blackbox', 'model', 'effects', 'estimate', 'discover', 'loop', 'separation',
    ):
        files += sorted((SYSID / room).rglob('*.py'))
    files += [
        path
        for path in sorted(TUNING.rglob('*.py'))
        if path.relative_to(TUNING).parts[0] not in ORCHESTRATION and path.name != 'cli.py'
    ]
    return [path for path in files if path.exists()]


def imports(source: str) -> set[str]:
    """Dotted names that a module imports, wherever in it the import stands."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module)
            found |= {f'{node.module}.{alias.name}' for alias in node.names}
    return found


def offences(source: str) -> list[str]:
    """What a maths module must not do: imports of the outside, calls that touch files."""
    found = sorted({name for name in imports(source) if name.split('.')[0] in OUTSIDE_MATHS})
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, 'id', getattr(node.func, 'attr', ''))
            if name in FILE_CALLS:
                found.append(f'{name}() in line {node.lineno}')
    return found


def of_a_node(path: Path) -> bool:
    """Whether a module is `x_node.py` or a part of that node, `x_….py`."""
    nodes = {p.stem.removesuffix('_node') for p in (ROOT / path).parent.glob('*_node.py')}
    return any(path.stem.startswith(f'{name}_') for name in nodes)


def below(folder: Path, *prefixes: str) -> dict[str, set[str]]:
    """Modules under `folder` that import something starting with one of `prefixes`."""
    hits = {}
    for path in sorted(folder.rglob('*.py')):
        names = {n for n in imports(path.read_text()) if n.startswith(prefixes)}
        if names:
            hits[str(path.relative_to(ROOT))] = names
    return hits


@pytest.mark.parametrize('path', maths_files(), ids=lambda p: str(p.relative_to(ROOT / 'src')))
def test_maths_touches_neither_ros_nor_files(path: Path) -> None:
    assert offences(path.read_text()) == []


@pytest.mark.parametrize(
    'source',
    [
        'import rclpy',
        'def f():\n    from matplotlib import pyplot',
        'from rosbags.highlevel import AnyReader',
        'import json',
        "open('x')",
        "from pathlib import Path\nPath('x').write_text('')",
        'import numpy as np\nnp.loadtxt(1)',
    ],
)
def test_the_check_itself_finds_each_kind_of_offence(source: str) -> None:
    assert offences(source)


def test_packages_import_one_way() -> None:
    assert below(BRIDGE, 'quad_sysid', 'quad_tuning') == {}
    assert below(SYSID, 'quad_tuning') == {}


def test_the_analysis_never_imports_the_virtual_stm32() -> None:
    assert below(SYSID, 'quad_bridge.virtual') == {}
    assert below(TUNING, 'quad_bridge.virtual') == {}


def test_offline_modules_do_not_need_ros() -> None:
    ros = ('rclpy', 'quad_bridge', 'sensor_msgs', 'rcl_interfaces', 'ament_index_python')
    hits = below(SYSID, *ros) | below(TUNING, *ros)
    assert [path for path in hits if not of_a_node(Path(path)) and '/demo/' not in path] == []


def test_wire_reads_no_port() -> None:
    for path in sorted((BRIDGE / 'wire').rglob('*.py')):
        names = {n.split('.')[0] for n in imports(path.read_text())}
        assert not names & {'serial', 'rclpy', 'socket', 'select', 'termios', 'fcntl'}, path


def test_import_linter_agrees() -> None:
    if importlib.util.find_spec('importlinter') is None:
        pytest.skip('import-linter is not installed')
    done = subprocess.run(
        [sys.executable, '-c', 'from importlinter.cli import lint_imports_command as c; c()'],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
