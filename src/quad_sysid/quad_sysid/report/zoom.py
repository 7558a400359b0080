"""Time series of a page that zoom, with nothing loaded from the network: zoom.js draws them.

Samples are 16 bit; a long flight is embedded as the lowest and highest of each bin, so that a
page stays below its limit.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from quad_sysid.contract import FloatArray

INT16 = np.iinfo(np.int16)
"""What a sample is coded in; the least one stands for a lost sample (zoom.js)."""
STYLE = """.zoom{margin:.6em 0;outline-offset:4px}.zoomrow{display:block;width:100%;height:130px;
touch-action:pan-y;cursor:crosshair}.zoomhead{font-size:.85rem;margin:.5em 0 0}
.zoomhead span{margin-left:1em}.zoombar{display:flex;gap:4px}.zoombar button{font:inherit;
min-width:2.4em;padding:2px 8px;border:1px solid var(--line);border-radius:6px;
background:var(--card);color:var(--ink);cursor:pointer}.zoomsay{min-height:2.6em}"""
HELP = ('Drag to zoom in, double click for all; Shift and drag moves; with the plot in focus the '
        'wheel and the keys + − ← → 0 do too; two fingers on a phone.')


@dataclass(frozen=True)
class Line:
    """One line of a row."""

    name: str
    values: FloatArray
    """(n,) NaN where nothing was measured."""
    colour: str
    """CSS variable of the page, such as `--blue`."""


@dataclass(frozen=True)
class Row:
    """Lines over one scale."""

    label: str
    """Name of the quantity, with its unit."""
    lines: Sequence[Line]


@dataclass(frozen=True)
class Mark:
    """A shaded stretch."""

    start_s: float
    end_s: float
    colour: str


def group(rows: Sequence[Row], dt: float, marks: Sequence[Mark] = (),
          budget: int = 1_100_000) -> str:
    """The element that zoom.js fills: rows of lines of equal length, dt s apart.

    budget: characters that the samples may take.
    """
    n = max((len(line.values) for row in rows for line in row.lines), default=0)
    count = sum(len(row.lines) for row in rows)
    every = 1
    while count * (n if every == 1 else 2 * n / every) * 8 / 3 > budget:
        every = 3 if every == 1 else every + 1
    data = {'dt': dt, 'length_s': n * dt,
            'rows': [{'label': row.label, 'lines': [_line(line, every) for line in row.lines]}
                     for row in rows],
            'marks': [{'start': m.start_s, 'end': m.end_s, 'colour': m.colour} for m in marks]}
    names = escape('; '.join(f'{row.label}: {", ".join(line.name for line in row.lines)}'
                             for row in rows))
    text = json.dumps(data, separators=(',', ':'), allow_nan=False).replace('<', '\\u003c')
    note = '' if every == 1 else f' Drawn by the lowest and highest of {every} samples each.'
    return (f'<div class="zoom" aria-label="{names}"><script type="application/json">{text}'
            f'</script></div><p class="small">{HELP}{note}</p>')


def _line(line: Line, every: int) -> dict[str, object]:
    values = np.asarray(line.values, dtype=float)
    if every > 1:
        padded = np.full(-(-len(values) // every) * every, np.nan)
        padded[:len(values)] = values
        bins = padded.reshape(-1, every)
        drawn = np.isfinite(bins).any(axis=1)
        least, most = (np.where(drawn, f(np.where(np.isfinite(bins), bins, fill), axis=1), np.nan)
                     for f, fill in ((np.min, np.inf), (np.max, -np.inf)))
        values = np.column_stack([least, most]).ravel()
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    offset, scale = 0.5 * (low + high), max((high - low) / (2.0 * INT16.max), 1e-12)
    coded = np.where(np.isfinite(values), np.round((np.nan_to_num(values) - offset) / scale),
                     INT16.min)
    return {'name': line.name, 'colour': line.colour, 'every': every,
            'offset': float(f'{offset:.7g}'), 'scale': float(f'{scale:.7g}'),
            'data': base64.b64encode(coded.astype('<i2').tobytes()).decode('ascii')}
