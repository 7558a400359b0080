"""Writes what an identification leaves: report.json, model.json, report.html, pictures/."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import plots
from quad_sysid.report.html import page
from quad_sysid.report.model_file import save_models, tree_of


def free_folder(wanted: Path) -> Path:
    """`wanted`, or with .1, .2, … where that exists: nothing is overwritten unasked."""
    folder = wanted
    number = 0
    while folder.exists():
        number += 1
        folder = wanted.with_name(f'{wanted.name}.{number}')
    return folder


def check_place(folder: Path) -> None:
    """Raise BadInputError where `folder` cannot be made or written; makes nothing itself."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise BadInputError('--out', f'{there} is not a folder', remedy='choose another place')
    if not os.access(there, os.W_OK | os.X_OK):
        raise BadInputError('--out', f'{there} cannot be written', remedy='choose another place')


def write(
    folder: Path, report: Mapping[str, Any], answers: Mapping[str, AxisAnswer],
    *, html: bool = True, pictures: bool = True,
) -> None:
    """All files of a report; report.json comes last, so that who waits for it finds the rest.

    `html` False writes no report.html; `pictures` False no folder `pictures` of PNG files (the
    page has its own inside). With neither, nothing is drawn.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError('--out', f'{folder} cannot be made', error.strerror) from error
    models = {axis: a.model for axis, a in answers.items() if a.model is not None}
    if models:
        blackbox = {
            axis: tree_of(a.rows[a.selected].step_a.model)
            for axis, a in answers.items() if a.selected is not None
        }
        save_models(models, folder / 'model.json', blackbox)
    if html or pictures:
        drawn = {axis: plots.gallery(answer) for axis, answer in answers.items()}
        if pictures:
            plots.save(drawn, folder / 'pictures')
        if html:
            _replace(folder / 'report.html', page(report, answers, drawn))
    _replace(folder / 'report.json', json.dumps(report, indent=1, allow_nan=False) + '\n')


def _replace(path: Path, text: str) -> None:
    """Write the file whole or not at all."""
    try:
        with tempfile.NamedTemporaryFile(
            'w', dir=path.parent, prefix=f'.{path.name}.', delete=False, encoding='utf-8'
        ) as stream:
            stream.write(text)
        Path(stream.name).chmod(0o666 & ~_umask())
        Path(stream.name).replace(path)
    except OSError as error:
        raise BadInputError(str(path), 'cannot be written', error.strerror) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
