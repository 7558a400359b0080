"""The demo's result folder: made anew, an earlier one kept aside as demo_out.1, .2, and so on."""

from __future__ import annotations

from pathlib import Path


def fresh_folder(folder: Path) -> Path | None:
    """Make `folder`; where it holds something, rename that first and return its new path.

    Raises FileExistsError where `folder` is a file.
    """
    aside = None
    if folder.is_dir() and any(folder.iterdir()):
        number = 1
        aside = folder.with_name(f'{folder.name}.{number}')
        while aside.exists():
            number += 1
            aside = folder.with_name(f'{folder.name}.{number}')
        folder.rename(aside)
    folder.mkdir(parents=True, exist_ok=True)
    return aside
