"""The form of the source files: their size, their opening, and nothing of one machine in them."""

from __future__ import annotations

import ast
import re
import subprocess
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted(
    path
    for package in ('quad_bridge', 'quad_sysid', 'quad_tuning')
    for path in (ROOT / 'src' / package / package).rglob('*.py')
)
LONG, TOO_LONG = 450, 600
GENERATED = {Path('src/quad_bridge/quad_bridge/wire/dialect.py')}


def tracked() -> list[Path]:
    """Text files of the project, as git lists them (all sources where there is no git)."""
    listed = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode != 0:
        return MODULES
    return [ROOT / name for name in listed.stdout.split('\0') if name]


def test_no_module_has_outgrown_its_room() -> None:
    lines = {p.relative_to(ROOT): len(p.read_text().splitlines()) for p in MODULES}
    for generated in GENERATED:
        lines.pop(generated, None)
    for path, count in lines.items():
        if count > LONG:
            warnings.warn(f'{path} has {count} lines (aim: {LONG})', stacklevel=1)
    assert {path: count for path, count in lines.items() if count > TOO_LONG} == {}


@pytest.mark.parametrize('path', MODULES, ids=lambda p: str(p.relative_to(ROOT / 'src')))
def test_each_module_opens_with_what_it_is(path: Path) -> None:
    assert ast.get_docstring(ast.parse(path.read_text()))
    assert path.stem not in {'utils', 'util', 'helpers', 'helper', 'misc', 'common'}


def test_nothing_of_one_machine_in_the_project() -> None:
    private = re.compile(r'/(?:home|root|Users)/\w+/|' + re.escape(str(ROOT)))
    found = []
    for path in tracked():
        try:
            text = path.read_text()
        except (UnicodeDecodeError, FileNotFoundError, IsADirectoryError):
            continue
        found += [f'{path.relative_to(ROOT)}: {m.group()}' for m in private.finditer(text)]
    assert found == []
