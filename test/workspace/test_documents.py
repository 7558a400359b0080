"""What README, CONTRIBUTING and docs tell a reader to type exists, and their links lead on."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'ARCHITECTURE.md',
    *sorted((ROOT / 'docs').rglob('*.md')),
]  # fmt: skip
page = pytest.mark.parametrize('path', PAGES, ids=lambda p: str(p.relative_to(ROOT)))


@page
def test_make_targets_exist(path: Path) -> None:
    targets = set(re.findall(r'^([a-z-]+):', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    named = re.findall(
        r'`make ([a-z-]+)|^\s*(?:\$ )?make ([a-z-]+)', path.read_text(), re.MULTILINE
    )
    assert {a or b for a, b in named} <= targets


@page
def test_executables_exist(path: Path) -> None:
    for package, command in re.findall(r'ros2 run (quad_\w+) ([\w-]+)', path.read_text()):
        setup = (ROOT / 'src' / package / 'setup.py').read_text()
        assert re.search(rf"['\"]{re.escape(command)}\s*=", setup), f'{package} {command}'


@page
def test_launch_files_exist(path: Path) -> None:
    for package, name in re.findall(r'ros2 launch (quad_\w+) ([\w.]+)', path.read_text()):
        assert (ROOT / 'src' / package / 'launch' / name).exists()


@page
def test_links_lead_to_files(path: Path) -> None:
    for target in re.findall(r'\]\(([^)#]+)(?:#[^)]*)?\)', path.read_text()):
        if not target.startswith(('http://', 'https://', 'mailto:')):
            assert (path.parent / target).exists(), target
