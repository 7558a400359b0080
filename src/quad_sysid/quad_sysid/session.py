"""One identification from bags to the files a user keeps; what the command and the node share.

The mathematics is imported where it is called: numba and scipy take seconds, and a node or a
command that is asked wrongly needs neither.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from quad_sysid.bags import parse_span
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.result import Result, identify

if TYPE_CHECKING:
    from quad_sysid.separation.design import Separation

@dataclass(frozen=True)
class Request:
    """What is asked; empty strings and tuples mean what the command's help says is the default."""

    bags: tuple[str, ...]
    axes: tuple[str, ...] = ()
    train: str = ''
    validate: str = ''
    out: str = ''
    inertia: str = ''
    search_effects: bool = True
    table2: bool = False


def run(request: Request, progress: Callable[[str], None] = lambda _: None) -> Result:
    """Read, identify, design, write. Raises QuadSysidError for what a user can mend."""
    from quad_sysid.report import store

    inertia = parse_inertia(request.inertia)
    train = parse_span(request.train, '--train') if request.train else None
    validate = parse_span(request.validate, '--validate') if request.validate else None
    if request.out:
        store.check_place(Path(request.out))
    found = identify(
        request.bags, request.axes, train=train, validate=validate, inertia=inertia,
        effects=None if request.search_effects else (), table2=request.table2, progress=progress,
    )
    progress('writing the report')
    saved = found.save(request.out or None)
    progress('')
    return saved


def run_apart(
    request: Request, progress: Callable[[str], None] = lambda _: None
) -> Iterator[tuple[str, Result | QuadSysidError]]:
    """Each bag by itself, its report in a folder of its own; one bad bag stops no other.

    With `out`, folders are made in it by the bags' names.
    """
    from quad_sysid.report import store

    for number, bag in enumerate(request.bags, 1):
        name = Path(bag).resolve().stem
        out = str(store.free_folder(Path(request.out) / name)) if request.out else ''
        told = f'bag {number} of {len(request.bags)}, '
        try:
            outcome: Result | QuadSysidError = run(
                replace(request, bags=(bag,), out=out),
                _behind(told, progress),
            )
        except QuadSysidError as error:
            outcome = error
        yield bag, outcome


def _behind(told: str, progress: Callable[[str], None]) -> Callable[[str], None]:
    """Progress whose lines stand behind `told`."""
    return lambda line: progress(told + line if line else line)


def separation(
    names: Sequence[str], model_file: str | None, axis: str | None, seconds: float,
    progress: Callable[[str], None] = lambda _: None,
) -> Separation:
    """The flights that tell two effects apart, on a stored model or the paper's aircraft.

    No names: an effect of the model and its nearest rival. Raises QuadSysidError for what a user
    can mend.
    """
    from quad_sysid.report.model_file import load_models
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
    if axis is not None and axis not in models:
        raise BadInputError(f'{model_file}: axes', 'lacks this axis', axis,
                            f'it holds {", ".join(models)}')
    model = models[axis] if axis else nearest(models)
    return separate(model, names, seconds, told=model_file, progress=progress)


def axes_of(name: str | None) -> tuple[str, ...]:
    """The axes an option names: one, `all`, or nothing for what the bag excites."""
    if not name:
        return ()
    if name == 'all':
        return AXES
    if name not in AXES:
        raise BadInputError('axis', f'must be of {", ".join(AXES)}, all', repr(name))
    return (name,)


def parse_inertia(given: str) -> dict[str, float] | None:
    """`IX,IY,IZ` in kg m² by axis; None for an empty string."""
    if not given:
        return None
    try:
        values = [float(part) for part in given.split(',')]
    except ValueError:
        values = []
    if len(values) != len(AXES) or not all(0.0 < v < 1e3 for v in values):
        raise BadInputError('--inertia', 'needs three positive numbers IX,IY,IZ', repr(given),
                            'for example --inertia 0.0135,0.014,0.024')
    return dict(zip(AXES, values, strict=True))


def bag_is_complete(event: Sequence[tuple[str, str]]) -> str:
    """The path in a /logger/bag event that says complete, else an empty string."""
    values = dict(event)
    return values.get('path', '') if values.get('state') == 'complete' else ''
