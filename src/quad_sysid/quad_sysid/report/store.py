"""Writes report.json, model.json, report.html, pictures/."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from quad_sysid.axes import EVERY
from quad_sysid.beside import side_by_side
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_own, check_place, make_folder, unfinished, write_whole
from quad_sysid.interrupt import uninterrupted
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import plots
from quad_sysid.report.html import page
from quad_sysid.report.model_file import save_models, tree_of
from quad_sysid.whole import URDF


def clear(folder: Path) -> None:
    """Remove what an earlier report left in a folder, and nothing else: an answer may lack files.

    Raises BadInputError where a file cannot be removed.
    """
    drawn = folder / 'pictures'
    files = [folder / name for name in ('report.json', 'model.json', 'report.html', URDF)]
    files += [drawn / f'{axis}_{picture.name}.png' for axis in EVERY for picture in plots.PICTURES]
    try:
        for file in files:
            file.unlink(missing_ok=True)
    except OSError as error:
        raise BadInputError(str(error.filename), 'cannot be removed', error.strerror,
                            'choose another --out') from error
    with suppress(OSError):  # none there, or it holds files that are not ours
        drawn.rmdir()


def write(folder: Path, report: Mapping[str, Any], answers: Mapping[str, AxisAnswer], *,
          html: bool = True, pictures: bool = True, urdf: str = '') -> None:
    """Write all files of a report, report.json last, so that the others exist once it does.

    Those of an earlier report there are replaced once all are written. Raises BadInputError where
    the folder holds what is no report.

    `html` False writes no report.html; `pictures` False no folder `pictures` of PNG files (the
    page has its own inside). With neither, nothing is drawn.
    """
    check_own(folder)
    with unfinished(check_place(folder)) as draft:
        _write(draft, report, answers, html=html, pictures=pictures)
        if urdf:
            write_whole(draft / URDF, urdf)
        with uninterrupted():
            make_folder(folder)
            clear(folder)
            _move(draft, folder)


def _move(draft: Path, folder: Path) -> None:
    """Move all files of the draft to their places in a folder."""
    for path in sorted(draft.rglob('*'), key=lambda path: path.name == 'report.json'):
        target = folder / path.relative_to(draft)
        try:
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                path.replace(target)
        except OSError as error:
            raise BadInputError(str(target), 'cannot be written', error.strerror,
                                'choose another --out') from error


def _write(folder: Path, report: Mapping[str, Any], answers: Mapping[str, AxisAnswer], *,
           html: bool, pictures: bool) -> None:
    models = {axis: a.model for axis, a in answers.items() if a.model is not None}
    if models:
        blackbox = {axis: tree_of(a.rows[a.selected].step_a.model)
                    for axis, a in answers.items() if a.selected is not None}
        save_models(models, folder / 'model.json', blackbox)
    if html or pictures:
        drawn = {axis: plots.gallery(answer) for axis, answer in answers.items()}
        side_by_side([
            *([partial(plots.save, drawn, folder / 'pictures')] if pictures else []),
            *([lambda: write_whole(folder / 'report.html', page(report, answers, drawn))
               ] if html else []),
        ])
    write_whole(folder / 'report.json', json.dumps(report, indent=1, allow_nan=False) + '\n')
