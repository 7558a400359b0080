"""The form of the source files: their size, their opening, and nothing of one machine in them."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted(
    path
    for package in ('quad_bridge', 'quad_sysid', 'quad_tuning')
    for path in (ROOT / 'src' / package / package).rglob('*.py')
)
TOO_LONG, GENERATED = 600, 'dialect.py'


@pytest.mark.parametrize('path', MODULES, ids=lambda p: str(p.relative_to(ROOT / 'src')))
def test_each_module_opens_with_what_it_is_and_is_no_longer_than_a_thought(path: Path) -> None:
    text = path.read_text()
    assert ast.get_docstring(ast.parse(text))
    assert path.stem not in {'utils', 'util', 'helpers', 'helper', 'misc', 'common'}
    assert len(text.splitlines()) <= TOO_LONG or path.name == GENERATED


def test_nothing_of_one_machine_in_the_project() -> None:
    listed = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True, check=False
    )
    names = listed.stdout.split('\0') if listed.returncode == 0 else MODULES
    private = re.compile(r'/(?:home|root|Users)/\w+/|' + re.escape(str(ROOT)))
    found = []
    for name in filter(None, names):
        try:
            text = (ROOT / name).read_text()
        except (UnicodeDecodeError, FileNotFoundError, IsADirectoryError):
            continue
        found += [f'{name}: {m.group()}' for m in private.finditer(text)]
    assert found == []
