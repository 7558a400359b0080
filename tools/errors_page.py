"""All errors of the packages, from the code: what is said, and what helps (an mkdocs hook).

`make docs` puts them into docs/reference/errors.md, so that the page cannot be behind the code;
`python tools/errors_page.py` prints them. Every call of an error class is read from the syntax
tree; what is filled in when it is raised stands in angle brackets.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PAGE, MARK = 'reference/errors.md', '<!-- errors -->'
PACKAGES = ('quad_bridge', 'quad_sysid', 'quad_tuning')
FIELDS = ('BadInputError', 'ConfigurationError', 'PathExistsError')
"""Take where, what, found and remedy; the others one text."""
READER = 'read_by_library'
"""Takes where, what and remedy, and raises a BadInputError."""
TEXTS = ('NotInformativeError', 'DesignRefusedError', 'RefusedError', 'QuadBridgeError',
         'EncodeError', 'StageFailedError')
MEANS = {
    'BadInputError': 'A file, a field or an argument is wrong (exit status 2).',
    'ConfigurationError': "The virtual STM32's profile or effect module is wrong (exit status 2).",
    'PathExistsError': 'The recording cannot have this place (exit status 2).',
    'NotInformativeError': 'The data are in order and cannot answer the question (exit status 3).',
    'DesignRefusedError': 'The model does not allow a design of gains (exit status 3).',
    'RefusedError': 'The bridge refuses a request: new gains, arming, a check.',
    'QuadBridgeError': 'The bridge cannot do what was asked (exit status 2).',
    'EncodeError': 'A frame of ours cannot be sent.',
    'StageFailedError': 'A stage of the demo failed; the demo ends with status 1.',
}

@dataclass(frozen=True)
class Said:
    """One error as the code raises it."""

    kind: str
    what: str
    remedy: str


def words(node: ast.expr | None) -> str:
    """A text as it will be read: its own words, and in brackets what is filled in."""
    if node is None:
        return ''
    if isinstance(node, ast.Constant):
        return '' if node.value is None else str(node.value)
    if isinstance(node, ast.JoinedStr):
        return ''.join(
            words(part.value if isinstance(part, ast.FormattedValue) else part)
            for part in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return words(node.left) + words(node.right)
    if isinstance(node, ast.IfExp):
        return ' / '.join(filter(None, (words(node.body), words(node.orelse))))
    return f'⟨{name_of(node)}⟩'


def name_of(node: ast.expr) -> str:
    """A short name for what is filled in."""
    if isinstance(node, ast.Attribute):
        return node.attr.strip('_').replace('_', ' ')
    if isinstance(node, ast.Name):
        return node.id.strip('_').replace('_', ' ')
    if isinstance(node, ast.Call):
        values = [a for a in node.args if not isinstance(a, ast.Constant)]
        if values and not isinstance(values[0], ast.GeneratorExp | ast.Starred):
            return name_of(values[0])
        return name_of(node.func)
    if isinstance(node, ast.Subscript):
        return name_of(node.value)
    return '…'


def said_in(path: Path) -> Iterator[Said]:
    """The errors of one file, in its order."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        kind = node.func.id if isinstance(node.func, ast.Name) else ''
        order = ('where', 'what', 'value', 'remedy')
        if kind == READER:
            kind, order = 'BadInputError', ('where', 'what', 'remedy')
        given = dict(zip(order, node.args, strict=False))
        given |= {k.arg: k.value for k in node.keywords if k.arg}
        if kind in FIELDS and 'what' in given:
            what = f"{words(given['where'])}: {words(given['what'])}"
            yield Said(kind, what, words(given.get('remedy')))
        elif kind in TEXTS and node.args:
            text = node.args[-1 if kind == 'StageFailedError' else 0]
            what, _, remedy = words(text).partition('; ')
            if re.search(r'[a-z]', re.sub('⟨.*?⟩', '', what)):
                yield Said(kind, what, remedy)


def listed() -> str:
    """All errors as Markdown, by package and subpackage."""
    parts = []
    for package in PACKAGES:
        top = ROOT / 'src' / package / package
        modules: dict[str, dict[Said, None]] = {}
        for path in sorted(top.rglob('*.py')):
            inside = path.relative_to(top)
            name = inside.parts[0] if len(inside.parts) > 1 else inside.stem
            modules.setdefault(name, {}).update(dict.fromkeys(said_in(path)))
        for name, errors in sorted(modules.items()):
            if errors:
                parts.append(f'\n## {package}: {cell(name)}')
            for kind, meaning in MEANS.items():
                rows = [one for one in errors if one.kind == kind]
                if rows:
                    parts.append(f'\n`{kind}`: {meaning}\n\n'
                                 '| what is wrong | what to do |\n|---|---|')
                    parts += [f'| {cell(one.what)} | {cell(one.remedy)} |' for one in rows]
    return '\n'.join(parts) + '\n'


def cell(text: str) -> str:
    """Text of a table's cell."""
    for old, new in (('|', '\\|'), ('<', '&lt;'), ('*', '\\*'), ('_', '\\_'), ('[', '\\[')):
        text = text.replace(old, new)
    return ' '.join(text.split())


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """The list in its place (called by mkdocs)."""
    return markdown.replace(MARK, listed()) if page.file.src_uri == PAGE else markdown


if __name__ == '__main__':
    sys.stdout.write(listed())
