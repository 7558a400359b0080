"""The notebook of the docs as a page of the site: executed, then Markdown (an mkdocs hook).

`python tools/notebook_page.py` executes it alone, as the test does; a cell that fails ends both.
"""

from __future__ import annotations

import posixpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import nbformat
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from traitlets.config import Config

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

NOTEBOOK = Path(__file__).resolve().parents[1] / 'docs' / 'notebook.ipynb'
CELL_TIMEOUT_S = 600


def executed(path: Path = NOTEBOOK) -> tuple[str, dict[str, bytes]]:
    """The page's Markdown and its pictures by file name. Raises what a cell raised."""
    notebook: Any = nbformat.read(path, as_version=4)
    local = Config({'KernelManager': {'transport': 'ipc'}})
    NotebookClient(notebook, timeout=CELL_TIMEOUT_S, config=local).execute()
    text, resources = MarkdownExporter().from_notebook_node(notebook)
    return text, dict(resources['outputs'])


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put the executed notebook in its place (called by mkdocs)."""
    from mkdocs.structure.files import File

    text, pictures = executed()
    files.append(File.generated(config, 'notebook.md', content=text))
    for name, content in pictures.items():
        files.append(File.generated(config, posixpath.join('', name), content=content))
    return files


if __name__ == '__main__':
    executed()
