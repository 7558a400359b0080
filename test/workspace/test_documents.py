"""What the pages tell a reader to use exists: targets, executables, launch files, links, site."""

import importlib.util
import re
from pathlib import Path

import pytest
from node_process import python

from quad_bridge.topics import TOPIC_TYPES

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / f'{name}.md' for name in ('README', 'CONTRIBUTING', 'ARCHITECTURE')),
    *sorted((ROOT / 'docs').rglob('*.md')),
]


@pytest.mark.parametrize('path', PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_a_page_names_exists(path: Path) -> None:
    text = path.read_text()
    assert '\n>>>>>>> ' not in text  # of a merge
    targets = set(re.findall(r'^([a-z-]+):', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    named = re.findall(r'`make ([a-z-]+)|^\s*(?:\$ )?make ([a-z-]+)', text, re.MULTILINE)
    assert {a or b for a, b in named} <= targets
    for package, command in re.findall(r'ros2 run (quad_\w+) ([\w-]+)', text):
        setup = (ROOT / 'src' / package / 'setup.py').read_text()
        assert re.search(rf"['\"]{re.escape(command)}\s*=", setup), f'{package} {command}'
    for package, name in re.findall(r'ros2 launch (quad_\w+) ([\w.]+)', text):
        assert (ROOT / 'src' / package / 'launch' / name).exists()
    for target in re.findall(r'\]\(([^)#]+)(?:#[^)]*)?\)', text):
        if not target.startswith(('http://', 'https://', 'mailto:')):
            assert (path.parent / target).exists(), target


def test_the_topics_of_page_and_table_agree() -> None:
    page = (ROOT / 'docs' / 'reference' / 'topics.md').read_text()
    rows = dict(re.findall(r'^\| `(/[^`]+)` \| (\S+)', page, re.MULTILINE))
    assert rows == {topic: kind.replace('/msg', '') for topic, kind in TOPIC_TYPES.items()}


def test_a_page_ends_with_what_may_go_wrong() -> None:
    """Those that are nothing else, and the lists of the reference, excepted."""
    without = {'index', 'limits', 'troubleshooting'}
    for path in (*(ROOT / 'docs').glob('*.md'), *(ROOT / 'docs/results').glob('*.md')):
        last = re.findall(r'^## (.*)', path.read_text(), re.MULTILINE)[-1:]
        assert path.stem in without or last == ['What may go wrong'], path.name


def test_the_site_lists_every_page() -> None:
    listed = set(re.findall(r'[\w/]+\.md', (ROOT / 'mkdocs.yml').read_text()))
    pages = {str(p.relative_to(ROOT / 'docs')) for p in PAGES[3:]}
    assert listed == pages | {'notebook.md'}  # made from notebook.ipynb


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec('mkdocs') is None, reason='mkdocs is not installed')
def test_what_is_made_for_the_site_stands_in_it(tmp_path: Path) -> None:
    """The notebook runs here; .ci/run builds the site by `make docs`, which refuses a warning."""
    done = python('-m', 'mkdocs', 'build', '--quiet', '--site-dir', tmp_path / 'site', cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]
    for page, words in {
        'reference/api': ('read_bag', 'AxisModel', 'CascadeGains', 'import_log'),
        'reference/errors': ('must be a finite number', 'chmod 600', 'no such axis'),
        'notebook': ('The plain model lacks dry friction', *4 * ('<img',)),
    }.items():
        text = (tmp_path / f'site/{page}.html').read_text()
        assert all(text.count(word) >= words.count(word) for word in words), page
