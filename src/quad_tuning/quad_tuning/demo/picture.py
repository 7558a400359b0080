"""The demo's picture: the square wave of both flights, measured over reference. PNG only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quad_sysid.contract import FloatArray

COLOURS = ('#d55e00', '#0072b2')
"""Of the flights; told apart by colour-blind people too."""


def draw_square(
    path: Path, flights: Sequence[tuple[str, FloatArray, FloatArray]], dt: float
) -> None:
    """Write the angle over the reference (n,), rad, of each (name, reference, angle) as PNG."""
    with mpl.rc_context({'font.size': 10}):
        figure = Figure(figsize=(9.0, 2.8 * len(flights)), layout='constrained')
        FigureCanvasAgg(figure)
        axes = np.atleast_1d(figure.subplots(len(flights), 1, sharex=True, sharey=True))
        for ax, (name, reference, angle), colour in zip(axes, flights, COLOURS, strict=False):
            time_s = np.arange(reference.size) * dt
            ax.plot(time_s, np.degrees(reference), color='0.5', lw=1.0, label='reference')
            ax.plot(time_s, np.degrees(angle), color=colour, lw=1.5, label='measured')
            ax.set_title(name, loc='left')
            ax.set_ylabel('roll angle, deg')
            ax.legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
            ax.grid(alpha=0.3)
        axes[-1].set_xlabel('time, s')
        figure.savefig(path, dpi=120)
