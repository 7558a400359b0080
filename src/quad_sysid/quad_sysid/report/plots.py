"""The table of pictures, in the order of reading.

To add a picture, add one entry here. The plots_*.py files draw, canvas.py has the look.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.text import Text

from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.files import make_folder, write_whole
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import plots_data, plots_effects, plots_loop, plots_models
from quad_sysid.report.canvas import Picture, png
from quad_sysid.units import spoken

PICTURES: tuple[tuple[str, Callable[[AxisAnswer], Picture | None]], ...] = (
    ('signals', plots_data.signals),
    ('coherence', plots_data.coherences),
    ('free_run', plots_models.free_run),
    ('horizon', plots_models.horizon),
    ('bode', plots_models.bode),
    ('left_out', plots_effects.left_out),
    ('effect_shape', plots_effects.effect_shapes),
    ('rivals', plots_effects.rivals),
    ('correlations', plots_models.correlations),
    ('residual_spectrum', plots_models.spectrum),
    ('missing_torque', plots_models.torque),
    ('closed_loop', plots_loop.overlay),
    ('step', plots_loop.step_response),
    ('margins', plots_loop.open_loop_margins),
)
"""Name and builder; a builder returns None where the answer lacks the data."""


@dataclass(frozen=True)
class Gallery:
    """The pictures of one axis, by name, and why others could not be drawn."""

    pictures: Mapping[str, Picture]
    failed: tuple[tuple[str, str], ...] = ()


def draw(answer: AxisAnswer, name: str) -> Picture | None:
    """One picture; None where the answer lacks the data. BadInputError for an unknown name."""
    build = dict(PICTURES).get(name)
    if build is None:
        names = ', '.join(dict(PICTURES))
        raise BadInputError('plot', 'no such picture', name, f'there are {names}')
    with np.errstate(all='ignore'):
        picture = build(answer)
    if picture is None or answer.units is None:
        return picture
    for text in picture.figure.findobj(Text):
        text.set_text(spoken(answer.units, text.get_text(), label=True))
    return replace(picture, title=spoken(answer.units, picture.title))


def gallery(answer: AxisAnswer) -> Gallery:
    """Draw all pictures of one axis; those that fail are listed in `failed`."""
    drawn: dict[str, Picture] = {}
    failed: list[tuple[str, str]] = []
    for name, _ in PICTURES:
        try:
            picture = draw(answer, name)
        except (QuadSysidError, ValueError, ArithmeticError, LookupError) as error:
            failed.append((name, str(error) or type(error).__name__))
            continue
        if picture is not None:
            drawn[name] = picture
    return Gallery(drawn, tuple(failed))


def save(galleries: Mapping[str, Gallery], folder: Path) -> None:
    """Write every picture as `<axis>_<name>.png` into `folder`, which is created if missing."""
    make_folder(folder, 'pictures')
    for axis, one in galleries.items():
        for name, picture in one.pictures.items():
            write_whole(folder / f'{axis}_{name}.png', png(picture))
