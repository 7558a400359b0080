"""The look of every picture of a report: colours, size, axes; inline SVG and PNG.

matplotlib is imported inside functions only, so that it loads only for pictures; pyplot with its
global state is not used. The plots_*.py files draw the content.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

    from quad_sysid.pipeline.answer import AxisAnswer

INK, MUTED, GRID = '#1b1f24', '#5f6b78', '#d5dae0'
BLUE, ORANGE, GREEN, SKY, PINK = '#0072b2', '#d55e00', '#009e73', '#56b4e9', '#cc79a7'
"""Okabe and Ito (2008): distinct for colour-blind readers."""
LINES = (BLUE, ORANGE, GREEN, PINK, SKY, INK, MUTED)
"""Of several lines in one panel."""

THEMED = {INK: 'ink', MUTED: 'muted', GRID: 'grid', BLUE: 'blue', ORANGE: 'orange', GREEN: 'green',
          SKY: 'sky', PINK: 'pink'}
"""Colour → the page's CSS variable, which differs between light and dark."""

MEASURED, BEFORE, AFTER, OTHER = INK, ORANGE, BLUE, GREEN
WIDTH_IN = 4.4
"""Width of all pictures: 317 pt, so that the text keeps its size on a phone."""
_RC: Any = {'svg.fonttype': 'none', 'font.family': 'sans-serif', 'font.size': 8.5,
            'axes.edgecolor': MUTED, 'axes.labelcolor': INK, 'text.color': INK,
            'xtick.color': MUTED, 'ytick.color': MUTED, 'xtick.labelcolor': INK,
            'ytick.labelcolor': INK, 'axes.spines.top': False, 'axes.spines.right': False,
            'axes.grid': True, 'grid.color': GRID, 'grid.linewidth': 0.6, 'axes.axisbelow': True,
            'lines.linewidth': 1.1, 'axes.titlesize': 8.5, 'axes.titlelocation': 'left',
            'legend.fontsize': 8.0, 'legend.frameon': False, 'xtick.labelsize': 8.0,
            'ytick.labelsize': 8.0, 'axes.formatter.useoffset': False, 'axes.unicode_minus': False,
            'path.simplify_threshold': 0.5}
"""The threshold, points, leaves out of long lines what cannot be seen at this width."""


@dataclass(frozen=True)
class Picture:
    """One figure with its title and caption."""

    name: str
    """Name of its PNG file and its anchor, such as `bode`."""
    title: str
    caption: str
    figure: Figure

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """(x label, y label) of every panel, the shared x label filled in."""
        shared = next((a.get_xlabel() for a in reversed(self.figure.axes) if a.get_xlabel()), '')
        return tuple((a.get_xlabel() or shared, a.get_ylabel()) for a in self.figure.axes)


@dataclass(frozen=True)
class Drawing:
    """A picture that the report of an axis may have."""

    name: str
    section: str
    """The heading of report.html below which it stands."""
    draw: Callable[[AxisAnswer], Picture | None]
    """Function that draws it; its result is None where the answer lacks the data."""


def panels(rows: int = 1, height_in: float = 3.0, *, share_x: bool = True,
           ratios: Sequence[float] | None = None, left_in: float = 0.7,
           spacing: float = 0.28) -> tuple[Figure, list[Axes]]:
    """A figure with panels below each other, margins in inches.

    `spacing`: the distance between them as a share of their height; more where each has its x.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_RC):
        figure = Figure(figsize=(WIDTH_IN, height_in))
        figure.patch.set_alpha(0.0)
        grid = figure.subplots(
            rows, squeeze=False, sharex=share_x,
            gridspec_kw={'left': left_in / WIDTH_IN, 'right': 1.0 - 0.12 / WIDTH_IN,
                         'bottom': 0.46 / height_in, 'top': 1.0 - 0.3 / height_in,
                         'hspace': spacing,
                         **({'height_ratios': list(ratios)} if ratios else {})},
        )
        axes = [panel for panel, in grid]
        for panel in axes:
            panel.patch.set_alpha(0.0)
            width_in = panel.get_position().width * WIDTH_IN
            panel.yaxis.set_label_coords(-(left_in - 0.14) / width_in, 0.5)
    return figure, axes


def legend(axes: Axes, columns: int = 4) -> None:
    """A legend in one line above the panel, outside the data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(handles, labels, loc='lower left', bbox_to_anchor=(-0.01, 0.985),
                    ncols=columns, borderaxespad=0.1, handlelength=1.3, columnspacing=1.0,
                    handletextpad=0.4, frameon=False, fontsize=8.0)


def plain_logarithms(axes: Sequence[Axes]) -> None:
    """Logarithmic scales with plain numbers, 1, 2, 5 where these fit."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for panel in axes:
        for scale in (panel.xaxis, panel.yaxis):
            if scale.get_scale() == 'log':
                low, high = sorted(scale.get_view_interval())
                few = high / max(low, 1e-300) < (1e4 if scale is panel.xaxis else 50.0)
                scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,),
                                                   numticks=12))
                scale.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
                scale.set_minor_locator(NullLocator())


def finish(axes: Sequence[Axes], x: str, *ys: str) -> None:
    """Label the panels, whose x is one, and put a legend over the first."""
    for panel, label in zip(axes, ys, strict=True):
        panel.set_ylabel(label)
        for scale in (panel.xaxis, panel.yaxis):
            if scale.get_scale() == 'log':
                _as_text(scale)
    axes[-1].set_xlabel(x)
    legend(axes[0])


_POWER = re.compile(r'\^\{([-0-9]+)\}')
_RAISED = str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹')


def _as_text(scale: Axis) -> None:
    """Powers of ten in plain characters: as formulas they take a sixth of all drawing."""
    from matplotlib.ticker import FuncFormatter, LogFormatterMathtext

    formatter = scale.get_major_formatter()
    if not isinstance(formatter, LogFormatterMathtext):
        return

    def plain(value: float, place: int | None) -> str:
        text = formatter(value, place).replace(r'$\mathdefault{', '').removesuffix('}$')
        return _POWER.sub(lambda power: power.group(1).translate(_RAISED), text)

    scale.set_major_formatter(FuncFormatter(plain))


def shade(axes: Axes, low: float, high: float, colour: str, label: str = '') -> None:
    """Shade a range of x."""
    axes.axvspan(low, high, color=colour, alpha=0.13, linewidth=0, label=label or None, zorder=0)


def svg(picture: Picture, prefix: str) -> str:
    """The figure as an `<svg>` element for a page: theme colours as CSS variables, no links."""
    import matplotlib as mpl

    stream = io.StringIO()
    with mpl.rc_context({**_RC, 'svg.hashsalt': f'{prefix}-{picture.name}'}):
        picture.figure.savefig(stream, format='svg', transparent=True, metadata={'Date': None})
    text = stream.getvalue()
    text = text[text.index('<svg'):]
    text = re.sub(r'<metadata>.*?</metadata>\s*', '', text, flags=re.DOTALL)
    text = re.sub(r'\s(?:xmlns(?::xlink)?|version|width|height)="[^"]*"', '', text, count=5)
    text = re.sub(r'<g id="[^"]*"', '<g', text).replace('xlink:href', 'href')
    text = re.sub(r'font: ([\d.]+px) [^;"]*', r'font: \1 var(--font)', text)
    text = re.sub(r'<[^>]+>', lambda tag: _LONG.sub(lambda digits: f'{float(digits.group()):.2f}',
                                                    tag.group()), text)
    for colour, name in THEMED.items():
        text = text.replace(colour, f'var(--{name})')
    text = text.replace('#000000', 'var(--ink)')
    label = re.sub(r'[<>&"]', ' ', f'{picture.title}. {picture.caption}')
    return text.replace('<svg', f'<svg role="img" aria-label="{label}"', 1)


def framed(picture: Picture, anchor: str, drawn: str = '') -> str:
    """The figure of a page with title and caption; `drawn` stands in it in place of the SVG."""
    return (f'<figure id="{escape(anchor)}"><h4>{escape(picture.title)}</h4>'
            f'{drawn or svg(picture, anchor)}'
            f'<figcaption>{escape(picture.caption)}</figcaption></figure>')


def embedded(picture: Picture, prefix: str) -> str:
    """The figure as an `<img>` for another page, such as a notebook."""
    coded = base64.b64encode(png(picture)).decode('ascii')
    label = f'{escape(prefix)}: {escape(picture.title)}'
    return f'<img alt="{label}" src="data:image/png;base64,{coded}">'


_LONG = re.compile(r'-?\d+\.\d{3,}')


def png(picture: Picture) -> bytes:
    """The figure on white, for a file."""
    import matplotlib as mpl

    stream = io.BytesIO()
    with mpl.rc_context(_RC):
        picture.figure.patch.set_alpha(1.0)
        picture.figure.savefig(stream, format='png', dpi=150, facecolor='white')
        picture.figure.patch.set_alpha(0.0)
    return stream.getvalue()
