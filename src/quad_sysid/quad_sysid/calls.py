"""Functions of `import quad_sysid` that take whatever the others return.

A model is a black box, an identified axis, a Result or the path of a model.json; a flight is a
Record, IOData or the path of a bag. The work is done in the packages that these functions name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from quad_sysid.errors import BadInputError
from quad_sysid.identified import Identified
from quad_sysid.model import AxisModel
from quad_sysid.record import IOData, Record
from quad_sysid.result import Result, model_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from quad_sysid.blackbox import FrequencyResponse, Model
    from quad_sysid.contract import FloatArray
    from quad_sysid.fleets.page import Fleet
    from quad_sysid.inspection.content import Content
    from quad_sysid.model import GainProposal

AnyModel: TypeAlias = 'Model | AxisModel | Result | str | Path'
AnyFlight: TypeAlias = 'Record | IOData | str | Path'


def simulate(model: AnyModel, u: npt.ArrayLike, x0: Any = None, **signals: Any) -> FloatArray:
    """(n,) output for inputs u (n,) without noise; see Identified.simulate, blackbox.simulate.

    x0: (rate, angle) of an axis, the filter's state of a black box; default: at rest.
    """
    start = {} if x0 is None else {'x0': x0}
    return model_of(model).simulate(u, **start, **signals)


def predict(model: AnyModel, flight: AnyFlight, horizon: float = 1) -> FloatArray:
    """(n,) output predicted `horizon` samples ahead, math.inf for the free run; NaN if unknown."""
    return model_of(model).predict(_data(model, flight), horizon)


def compare(data: Any, *others: Any, horizon: float = math.inf) -> tuple[Any, ...]:
    """Fit of each model on IOData, per cent (MATLAB: compare); or what changed between flights.

    compare(z, model, …): a fit for each model. compare(first, second, …), of results, models,
    records, paths of bags or of models: for each other one the flight and its changes, parameter
    by parameter, with the chance that nothing changed (comparison.Change).
    """
    from quad_sysid.blackbox import Model

    if isinstance(data, Model):
        raise BadInputError('compare', 'the data come first', 'a model', 'compare(z, model, …)')
    if not others:
        raise BadInputError('compare', 'needs something to compare with', remedy='compare(z, '
                            'model), or two flights')
    if isinstance(data, IOData) or any(isinstance(other, Model) for other in others):
        return tuple(model_of(other).compare(_data(other, data), horizon) for other in others)
    from quad_sysid import comparison

    reference, *further = map(comparison.flight_of, (data, *others))
    return comparison.compare(reference, further)


def bode(model: AnyModel, w: npt.ArrayLike | None = None) -> FrequencyResponse:
    """Response from input to output at w (m,), rad/s, with its covariance."""
    return model_of(model).bode(w)


def export(model: AnyModel, path: str | Path, to: str = '') -> Path:
    """Write an identified model for python-control (`control`) or MATLAB (`mat`).

    Raises BadInputError for a black box, which `to_control` makes a system, and where the file
    exists.
    """
    from quad_sysid.exports import export as write

    if isinstance(model, Result):
        return write({axis: model[axis].model for axis in model}, path, to)
    identified = model_of(model)
    if not isinstance(identified, Identified):
        raise BadInputError('export', 'writes models of an axis', 'a black box',
                            'model.to_control() makes it a system of python-control')
    return identified.export(path, to)


def inspect(flight: AnyFlight) -> Content:
    """Content of a flight and its possible uses, before any fit."""
    from quad_sysid.bags import split_segments
    from quad_sysid.inspection import content

    if isinstance(flight, str | Path):
        return content.content(flight)
    if not isinstance(flight, Record):
        raise BadInputError('inspect', 'takes a Record or the path of a bag',
                            type(flight).__name__, 'make one with from_arrays(u=…, y=…, dt=…)')
    named = any(s.role in ('train', 'validation') for s in flight.segments)
    return content.of_record(split_segments(flight), content.Topics((), (), ()), split=not named)


def fleet(flights: str | Path | Sequence[Record], out: str | Path = '',
          axes: Sequence[str] = (), *, aircraft: Sequence[str] = (), workers: int = 1,
          cluster: str = '', search_effects: bool = True, limit_s: float = 3600.0,
          group_by: str = 'aircraft', since: str = '') -> Fleet:
    """Identify every bag and log below a folder, or every record: rows, and what they say.

    A second call with the same `out` continues; records need none. `aircraft`: that of each
    record. `cluster`: a Dask scheduler (docs/fleet.md). `limit_s`: longest time for a bag.
    `group_by`: what is one aircraft, `aircraft` (the first folder), `folder` or `none`. `since`: a
    day, such as 2026-05-31 or 90d. Raises BadInputError where there is no bag.
    """
    from quad_sysid.fleets import bag, engine
    from quad_sysid.fleets.page import Fleet

    options: dict[str, Any] = {'axes': tuple(axes), 'search_effects': search_effects,
                               'limit_s': limit_s}
    fleet = Fleet([], group_by, since)
    if isinstance(flights, str | Path):
        if not out:
            raise BadInputError('fleet: out', 'is missing', remedy='name a folder for the results')
        every = bag.jobs(flights, out, **options)
    else:
        every = bag.of_records(flights, aircraft, str(out), **options)
    return replace(fleet, rows=engine.run(every, workers, cluster))


def import_log(path: str | Path, out: str | Path) -> Record:
    """A log of PX4, ArduPilot, Betaflight and so on as a bag at `out`; returns its Record.

    A table needs the meaning of its columns: from_arrays(frame, u='…', …). Raises BadInputError.
    """
    from quad_sysid.imports.formats import format_of, read_log
    from quad_sysid.imports.to_bag import import_log as write

    log_format = format_of(Path(path))
    if log_format is None:
        raise BadInputError(str(path), 'is of no known format of logs',
                            remedy="read the table and call from_arrays(frame, u='…', y='…')")
    return write(read_log(Path(path), log_format), Path(out)).record


def design(model: AnyModel) -> GainProposal:
    """Gains of one axis, or why there are none, by the installed designer (quad_tuning)."""
    from quad_sysid.result import installed_designer

    identified = model_of(model)
    if not isinstance(identified, Identified):
        raise BadInputError('design', 'needs the model of an axis', 'a black box')
    designer, missing = installed_designer()
    if designer is None:
        raise BadInputError('design', missing)
    return designer(identified.predicting)


def _data(model: Any, flight: Any) -> Any:
    """The flight as a black box takes it; as it is for a model of an axis."""
    from quad_sysid.blackbox import Model

    identified = model_of(model)
    if isinstance(flight, Model | AxisModel | Result):
        raise BadInputError('predict', 'the model comes first', type(flight).__name__,
                            'predict(model, z)')
    if not isinstance(identified, Model) or isinstance(flight, IOData):
        return flight
    from quad_sysid.bags import read_bag

    record = flight if isinstance(flight, Record) else read_bag(flight)
    axes = {s.axis for s in record.segments if s.role != 'idle'} or {'roll'}
    if len(axes) != 1:
        raise BadInputError('black box', 'a flight of several axes', ', '.join(sorted(axes)),
                            "take one: record.axis('roll')")
    return record.axis(axes.pop())
