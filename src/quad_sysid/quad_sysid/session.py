"""One identification from bags to its files, as command and node run it.

The mathematics is imported where it is called: numba and scipy take seconds, and a wrong argument
needs neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from quad_sysid.axes import axes_in
from quad_sysid.bags import parse_span
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_own, check_place
from quad_sysid.result import Result, identify


def keywords(axes: Sequence[str] = (), train: str = '', validate: str = '',
             inertia: str = '') -> dict[str, Any]:
    """Keywords of `identify` from typed arguments; empty ones mean its defaults.

    `axes`: names, `all` of the attitude, or `every` one; `train`, `validate`: `A:B`, s;
    `inertia`: `IX,IY,IZ`, kg m². Raises BadInputError naming the option.
    """
    return {'axes': axes_in(axes),
            'train': parse_span(train, '--train') if train else None,
            'validate': parse_span(validate, '--validate') if validate else None,
            'inertia': _inertia(inertia) if inertia else None}


def run(bags: Sequence[str], out: Path | None, keywords: Mapping[str, Any],
        progress: Callable[[str], None] = lambda _: None) -> Result:
    """Read, identify, design, write; `keywords` are those of `identify`.

    Without `out` a folder is created in the current directory. Raises QuadSysidError.
    """
    check_place(out or Path())
    if out is not None:
        check_own(out)
    result = identify(bags, progress=progress, **keywords)
    progress('writing the report')
    saved = result.save(out)
    progress('')
    return saved


def _inertia(text: str) -> dict[str, float]:
    """`IX,IY,IZ` in kg m² by axis."""
    try:
        values = [float(part) for part in text.split(',')]
    except ValueError:
        values = []
    if len(values) != len(AXES) or not all(0.0 < v < 1e3 for v in values):
        raise BadInputError('--inertia', 'needs three positive numbers IX,IY,IZ', repr(text),
                            'for example --inertia 0.0135,0.014,0.024')
    return dict(zip(AXES, values, strict=True))
