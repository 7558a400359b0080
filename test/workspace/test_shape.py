"""The form of the source files: their size, their opening, and nothing of one machine in them."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOO_LONG, GENERATED = 600, 'dialect.py'


def test_each_module_opens_with_what_it_is_and_is_no_longer_than_a_thought() -> None:
    for path in (ROOT / 'src').glob('quad_*/quad_*/**/*.py'):
        text = path.read_text()
        assert ast.get_docstring(ast.parse(text)), path
        assert path.stem not in {'utils', 'util', 'helpers', 'helper', 'misc', 'common'}
        assert len(text.splitlines()) <= TOO_LONG or path.name == GENERATED, path


def test_nothing_of_one_machine_in_the_project() -> None:
    private = re.compile(r'/(?:home|root|Users)/\w+/|' + re.escape(str(ROOT)))
    listed = subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, check=True)
    for name in filter(None, listed.stdout.decode().split('\0')):
        if (path := ROOT / name).is_file():
            assert not private.search(path.read_text(errors='replace')), name
