"""One identification from bags to its files, as command and node run it.

The mathematics is imported where it is called: numba and scipy take seconds, and a wrong argument
needs neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quad_sysid.bags import parse_span
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.result import Result, identify

if TYPE_CHECKING:
    from quad_sysid.separation.design import Separation


def asked(axes: Sequence[str] = (), train: str = '', validate: str = '',
          inertia: str = '') -> dict[str, Any]:
    """Keywords of `identify` from typed arguments; empty ones mean its defaults.

    `axes`: names, or `all`; `train`, `validate`: `A:B`, s; `inertia`: `IX,IY,IZ`, kg m². Raises
    BadInputError naming the option.
    """
    for name in axes:
        if name not in (*AXES, 'all'):
            raise BadInputError('axis', f'must be one of {", ".join(AXES)}, all', repr(name))
    return {'axes': AXES if 'all' in axes else tuple(axes),
            'train': parse_span(train, '--train') if train else None,
            'validate': parse_span(validate, '--validate') if validate else None,
            'inertia': _inertia(inertia) if inertia else None}


def run(bags: Sequence[str], out: Path | None, wanted: Mapping[str, Any],
        progress: Callable[[str], None] = lambda _: None) -> Result:
    """Read, identify, design, write; `wanted` are keywords of `identify`.

    Without `out` a folder is created in the current directory. Raises QuadSysidError.
    """
    from quad_sysid.report import store

    if out is not None:
        store.check_place(out)
    found = identify(bags, progress=progress, **wanted)
    progress('writing the report')
    saved = found.save(out)
    progress('')
    return saved


def separation(names: Sequence[str], model_file: str | None, axis: str | None, seconds: float,
               progress: Callable[[str], None] = lambda _: None) -> Separation:
    """The flights that separate two effects, for a stored model or the paper's aircraft.

    No names: an effect of the model and its nearest rival. Raises QuadSysidError.
    """
    from quad_sysid.report.model_file import load_models, pick
    from quad_sysid.result import separate
    from quad_sysid.separation.design import nearest

    if len(names) not in (0, 2):
        raise BadInputError('--separate', 'needs two effects or none', ' '.join(names) or None,
                            'for example --separate coulomb_friction quadratic_drag')
    if model_file is None:
        if not names:
            raise BadInputError('--separate', 'without effects needs --model',
                                remedy='name two effects, or give --model result/model.json')
        return separate(axis or AXES[0], names, seconds, progress=progress)
    models = load_models(model_file)
    model = pick(models, axis, model_file)[axis] if axis else nearest(models)
    return separate(model, names, seconds, told=model_file, progress=progress)


def _inertia(given: str) -> dict[str, float]:
    """`IX,IY,IZ` in kg m² by axis."""
    try:
        values = [float(part) for part in given.split(',')]
    except ValueError:
        values = []
    if len(values) != len(AXES) or not all(0.0 < v < 1e3 for v in values):
        raise BadInputError('--inertia', 'needs three positive numbers IX,IY,IZ', repr(given),
                            'for example --inertia 0.0135,0.014,0.024')
    return dict(zip(AXES, values, strict=True))
