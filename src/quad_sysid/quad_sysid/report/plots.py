"""All pictures of a report, drawn for an axis and saved.

To add a picture, add it to one of the plots_*.py files, which draw; canvas.py has the look.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.text import Text

from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.files import make_folder, write_whole
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import plots_data, plots_effects, plots_loop, plots_models
from quad_sysid.report.canvas import Drawing, Picture, png
from quad_sysid.units import in_units_of

PICTURES: tuple[Drawing, ...] = (
    *plots_data.DRAWINGS, *plots_models.DRAWINGS, *plots_effects.DRAWINGS, *plots_loop.DRAWINGS,
)


@dataclass(frozen=True)
class Gallery:
    """The pictures of one axis, by name, and why others could not be drawn."""

    pictures: Mapping[str, Picture]
    failed: tuple[tuple[str, str], ...] = ()


def draw(answer: AxisAnswer, name: str) -> Picture | None:
    """One picture; None where the answer lacks the data. BadInputError for an unknown name."""
    entry = next((picture for picture in PICTURES if picture.name == name), None)
    if entry is None:
        names = ', '.join(picture.name for picture in PICTURES)
        raise BadInputError('plot', 'no such picture', name, f'there are {names}')
    with np.errstate(all='ignore'):
        picture = entry.draw(answer)
    if picture is None or answer.units is None:
        return picture
    for text in picture.figure.findobj(Text):
        text.set_text(in_units_of(answer.units, text.get_text()))
    return replace(picture, title=in_units_of(answer.units, picture.title),
                   caption=in_units_of(answer.units, picture.caption))


def gallery(answer: AxisAnswer) -> Gallery:
    """Draw all pictures of one axis; those that fail are listed in `failed`."""
    drawn: dict[str, Picture] = {}
    failed: list[tuple[str, str]] = []
    for entry in PICTURES:
        try:
            picture = draw(answer, entry.name)
        except (QuadSysidError, ValueError, ArithmeticError, LookupError) as error:
            failed.append((entry.name, str(error) or type(error).__name__))
            continue
        if picture is not None:
            drawn[entry.name] = picture
    return Gallery(drawn, tuple(failed))


def save(galleries: Mapping[str, Gallery], folder: Path) -> None:
    """Write every picture as `<axis>_<name>.png` into `folder`, which is created if missing."""
    make_folder(folder, 'pictures')
    for axis, gallery in galleries.items():
        for name, picture in gallery.pictures.items():
            write_whole(folder / f'{axis}_{name}.png', png(picture))
