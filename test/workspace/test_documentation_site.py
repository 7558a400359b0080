"""The documentation builds with its links checked, and every page can be reached."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from probe import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(importlib.util.find_spec('mkdocs') is None, reason='mkdocs is not installed')
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--quiet', '--site-dir',
         str(tmp_path / 'site')],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    text = (tmp_path / 'site' / 'reference' / 'api.html').read_text()
    for name in ('read_bag', 'AxisModel', 'CascadeGains', 'import_log'):
        assert name in text
    pictures = re.findall(r'<img[^>]*src="([^"]+)"', (tmp_path / 'site/tune.html').read_text())
    assert all((tmp_path / 'site' / p).exists() for p in pictures if not p.startswith('http'))


def test_every_page_is_in_the_contents() -> None:
    listed = set(re.findall(r'[\w/]+\.md', (ROOT / 'mkdocs.yml').read_text()))
    pages = {str(p.relative_to(ROOT / 'docs')) for p in (ROOT / 'docs').rglob('*.md')}
    assert pages == listed
