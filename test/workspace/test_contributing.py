"""CONTRIBUTING.md: its worked changes, applied to a copy of the project, with their tests."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CHANGES = re.findall(r'```diff\n(.*?)```', (ROOT / 'CONTRIBUTING.md').read_text(), re.DOTALL)


def applied(place: Path, change: str) -> list[str]:
    """Apply a change whose hunks have no line numbers; returns the tests that it adds."""
    for file in re.split(r'^--- ', change, flags=re.MULTILINE)[1:]:
        name, *hunks = file.split('@@\n')
        path = place / name.strip()
        text = path.read_text() if path.exists() else ''
        for hunk in hunks:
            lines = hunk.splitlines(keepends=True)
            old = ''.join(line[1:] for line in lines if line[0] in ' -')
            new = ''.join(line[1:] for line in lines if line[0] in ' +')
            assert not old or text.count(old) == 1, f'{name.strip()}: {old!r}'
            text = text.replace(old, new) if old else f'{text}\n\n{new}'
        path.write_text(text.lstrip())
    return re.findall(r'^\+def (test_\w+)', change, re.MULTILINE)


def test_each_worked_change_works(tmp_path: Path) -> None:
    """All in one copy and one process: they do not meet."""
    for package in ('quad_bridge', 'quad_sysid'):
        shutil.copytree(ROOT / 'src' / package / package, tmp_path / 'src' / package / package)
    shutil.copytree(ROOT / 'test', tmp_path / 'test')
    shutil.copy(ROOT / 'pyproject.toml', tmp_path)
    (tmp_path / 'firmware').symlink_to(ROOT / 'firmware')
    tests = [test for change in CHANGES for test in applied(tmp_path, change)]
    assert len(tests) == len(CHANGES) == 5
    files = sorted({name for change in CHANGES for name in re.findall(r'^--- (test/\S+)', change,
                                                                     re.MULTILINE)})
    path = os.pathsep.join(str(tmp_path / 'src' / name) for name in ('quad_bridge', 'quad_sysid'))
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-n', '0', '-p', 'no:cacheprovider',
         '-k', ' or '.join(tests), *files],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': path + os.pathsep + os.environ.get('PYTHONPATH', '')},
    )
    assert '5 passed' in done.stdout, (done.stdout + done.stderr)[-3000:]
    assert done.returncode == 0
