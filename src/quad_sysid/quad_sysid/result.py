"""An identification as one call, its answer as one object.

    result = identify('my_flight', axes='roll')
    print(result); result.plot('missing_torque'); result.save('out')

The command and the node call this too. pipeline does the work, report the texts; numba, scipy and
matplotlib are loaded when they are needed.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from quad_sysid.axes import axis_of
from quad_sysid.bags import read_bag, split_segments
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError, NoSuchAttributeError
from quad_sysid.files import free_folder
from quad_sysid.identified import Identified
from quad_sysid.model import BEFORE, AxisModel, Designer, EffectEstimate
from quad_sysid.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from quad_sysid.arrays import Samples, Table
    from quad_sysid.blackbox import Model
    from quad_sysid.model.effect import Effect
    from quad_sysid.own_base import Base
    from quad_sysid.parts import Parts
    from quad_sysid.pipeline.answer import AxisAnswer
    from quad_sysid.pipeline.evaluate import Evaluation
    from quad_sysid.record import IOData
    from quad_sysid.separation.design import Separation
    from quad_sysid.whole import Whole

PROMISES = ('rate_rms_ratio', 'oscillation_ratio', 'peak')
"""Predictions of a design with which the bridge's watch compares the flight."""
DESIGNERS = 'quad_sysid.designers'
"""Group of entry points: quad_sysid does not import quad_tuning."""
Flights: TypeAlias = 'Record | IOData | str | Path | Sequence[Record | str | Path] | Table'
"""Flights of one aircraft, or what holds the arrays of experiments."""


@dataclass(frozen=True, repr=False)
class Result:
    """The answer of an identification: all axes, or one of them as `result['roll']`.

    Attributes of one axis (`verdict`, `effects`, `model` and so on) raise NoSuchAttributeError
    where there are several.
    """

    answers: Mapping[str, AxisAnswer]
    """Axis → everything behind the report."""
    flights: tuple[str, ...]
    """Sources of the flights."""
    inertia: Mapping[str, float] | None = None
    """Axis → kg m², to report torques in N m too."""
    whole: Whole | None = None
    """The aircraft as a whole; None where the flights are arrays."""
    folder: Path | None = None
    """Folder of the report, once it is saved."""
    stored: Mapping[str, Any] | None = None
    """The report that it was read from, by from_json."""

    def __getitem__(self, axis: str) -> Result:
        """The answer for one axis."""
        if axis not in self.answers:
            raise BadInputError('result', 'has no such axis', axis,
                                f'it has {", ".join(self.answers)}')
        return replace(self, answers={axis: self.answers[axis]})

    def __iter__(self) -> Iterator[str]:
        """The axes."""
        return iter(self.answers)

    def __len__(self) -> int:
        """Number of axes."""
        return len(self.answers)

    @cached_property
    def report(self) -> dict[str, Any]:
        """The tree of report.json (contract)."""
        from quad_sysid.report.document import document

        if self.stored is not None:
            return {**self.stored, 'axes': {a: self.stored['axes'][a] for a in self.answers}}
        return document(self.answers, self.flights, self.inertia, self.whole)

    @property
    def answer(self) -> AxisAnswer:
        """The whole answer of the axis, with data, search and held-out errors."""
        if len(self.answers) != 1:
            raise NoSuchAttributeError('result', 'has several axes', ', '.join(self.answers),
                                f"take one, such as result['{next(iter(self.answers), 'roll')}']")
        return next(iter(self.answers.values()))

    @property
    def verdict(self) -> str:
        """`effects_added`, `no_missing_effect`, `unexplained_residual` or `cannot_tell`."""
        return self.answer.verdict

    @property
    def reason(self) -> str:
        """The reason for the verdict, in words."""
        return self.answer.reason

    @property
    def model(self) -> Identified:
        """The base with the effects that were added; NoSuchAttributeError without one."""
        model = self.answer.model
        if model is None:
            raise NoSuchAttributeError('result', 'has no model', self.verdict, self.reason)
        return Identified(**vars(model))

    @property
    def effects(self) -> tuple[EffectEstimate, ...]:
        """The effects added to the base, with parameters, standard errors and probability."""
        return () if self.answer.model is None else self.answer.model.effects

    @property
    def rivals(self) -> dict[str, dict[str, float]]:
        """Effect → its alternatives, with their probabilities."""
        return {effect.name: dict(effect.rivals) for effect in self.effects}

    @property
    def errors(self) -> dict[str, Any]:
        """Errors on the held-out segments, in their `unit` (contract: `error`)."""
        return dict(self.report['axes'][self.answer.axis]['error'])

    def __repr__(self) -> str:
        """One line for each axis; `print` shows all of the answer."""
        lines = []
        for axis, answer in self.answers.items():
            effects = answer.model.effects if answer.model else ()
            lines.append(' '.join([f'{axis}:', answer.verdict, *(e.name for e in effects)]))
        return '\n'.join(lines)

    def __str__(self) -> str:
        """The text that the command prints."""
        from quad_sysid.report import text

        return '\n'.join(text.lines(self.report)).strip('\n')

    def _repr_html_(self) -> str:
        """HTML for a notebook: answer, tables, and the main picture of each axis."""
        from quad_sysid.report.html import excerpt

        return excerpt(self.report, self.answers, str(self))

    def plot(self, name: str = 'missing_torque') -> Figure:
        """One picture of the report as a matplotlib figure, such as `free_run` or `bode`.

        Raises BadInputError for an unknown name, or where the data do not allow the picture.
        """
        from quad_sysid.report.plots import draw

        picture = draw(self.answer, name)
        if picture is None and self.answer.findings is None and self.answer.model is not None:
            raise BadInputError('plot', 'the flight is not in this result', name,
                                'a result of from_json has no pictures; identify again')
        if picture is None:
            raise BadInputError('plot', 'the data do not allow this picture', name,
                                f'the verdict is {self.verdict}: {self.reason}')
        return picture.figure

    def to_json(self) -> str:
        """The answer as text: report and models, without loss; see `from_json`."""
        from quad_sysid.report.model_file import tree_of_models

        models = {axis: answer.model for axis, answer in self.answers.items()
                  if answer.model is not None}
        return json.dumps({'report': self.report, 'flights': list(self.flights),
                           'inertia': self.inertia and dict(self.inertia),
                           'models': tree_of_models(models) if models else None},
                          allow_nan=False)

    @classmethod
    def from_json(cls, text: str, effects: Sequence[Effect] = ()) -> Result:
        """A result from `to_json`: all but the pictures, which need the flight.

        `effects`: those of one's own that it names. Raises BadInputError for another text.
        """
        from quad_sysid.report.document import answers_of
        from quad_sysid.report.model_file import models_of

        try:
            tree = json.loads(text)
            report, models = tree['report'], tree['models']
            flights, inertia = tuple(tree['flights']), tree['inertia']
        except (ValueError, TypeError, KeyError) as error:
            raise BadInputError('from_json', 'is no result of to_json', str(error)) from error
        known = models_of(models, 'from_json', effects) if models else {}
        return cls(answers_of(report, known), flights, inertia, stored=report)

    def save(self, folder: str | Path | None = None, *, html: bool = True,
             pictures: bool = True) -> Result:
        """Write report.json, model.json, report.html, pictures/; returns the stored result.

        Without `folder` a new one, named after the flight, is created in the current directory.
        """
        from quad_sysid.report import store

        place = Path(folder) if folder else free_folder(
            Path(f'{Path(self.flights[0]).resolve().stem}_identified')
        )
        store.write(place, self.report, self.answers, html=html, pictures=pictures,
                    urdf=self.report.get('aircraft', {}).get('urdf', ''))
        return replace(self, folder=place)

    @property
    def answered(self) -> bool:
        """Whether any of the axes could be answered."""
        return any(answer.answered for answer in self.answers.values())

    @property
    def reasons(self) -> str:
        """The reasons why axes could not be answered, in one line."""
        from quad_sysid.report.words import by_reason

        return by_reason({axis: answer.reason for axis, answer in self.answers.items()
                          if not answer.answered})

    @property
    def gains(self) -> dict[str, float]:
        """The designed gains of all axes by the contract's names; none of refused axes."""
        return {name: value for _, gains, _ in self._proposed() for name, value in gains.items()}

    def sent_with(self) -> dict[str, str]:
        """Fields beside the gains in /gains/update; see the function `sent_with`."""
        return sent_with({axis: figures for axis, _, figures in self._proposed()})

    def refusals(self) -> dict[str, str]:
        """Axis → why there are no gains."""
        return {axis: answer.proposal.refused_because
                for axis, answer in self.answers.items()
                if answer.proposal is not None and answer.proposal.gains is None}

    def _proposed(self) -> Iterator[tuple[str, Mapping[str, float], Mapping[str, float]]]:
        for axis, answer in self.answers.items():
            if answer.proposal is not None and answer.proposal.gains is not None:
                yield axis, answer.proposal.gains, answer.proposal.figures


def sent_with(figures: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Fields beside designed gains in /gains/update, each as JSON, from the figures per axis.

    `predicted` is for the watch in flight; `flown` are the gains that the design improves, which
    the aircraft must have.
    """
    predicted = {f'{axis}.{name}': round(row[name], 6)
                 for axis, row in figures.items() for name in PROMISES if name in row}
    error_before = {name.removesuffix(BEFORE): value
                    for axis, own in figures.items() for name, value in own.items()
                    if name.startswith(f'{axis}.') and name.endswith(BEFORE)}
    return {'predicted': json.dumps(predicted), 'flown': json.dumps(error_before)}


def identify(
    flights: Flights | None = None, axes: str | Sequence[str] = (), *,
    u: Samples | None = None, y: Samples | None = None, dt: float | Sequence[float] | None = None,
    t: Samples | None = None, angle: Samples | None = None, reference: Samples | None = None,
    signals: Mapping[str, Samples] | None = None, units: Mapping[str, str | float] | None = None,
    gains: Mapping[str, float] | None = None,
    train: Parts | None = None, validate: Parts | None = None,
    effects: Sequence[Effect] | None = None, extra_effects: Sequence[Effect] = (),
    base: Base | None = None,
    designer: Designer | None = None, inertia: Mapping[str, float] | None = None,
    mass: float | None = None, thrust: float | None = None,
    progress: Callable[[str], object] = lambda _: None, seconds: float | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Identify axes from flights of one aircraft, or from arrays, and find what the model lacks.

    `flights`: records or paths of bags, or a frame, a response, IOData with what `u`, `y` and so
    on say of it; arrays alone need no `flights` (from_arrays has their shapes, units, errors; a
    list has one for each experiment). `axes`: `roll`, `pitch`, `yaw`, `surge`,
    `sway`, `climb`; default: those that the
    flights excite; of arrays the one that they are called, `roll`. `train`, `validate`: Parts, or
    (start, end), s from the first sample; default: the bag's segments, else 60 and 40 %.
    `effects`: the candidates; default `EFFECTS`, `()` for none; `extra_effects` join them.
    `base`: your own law in place of gain, lag, delay and damping, whose parameters the model then
    has as `<name of the base>.<parameter>`.
    `mass` (kg) or `thrust` (N, of all motors at full command): of the aircraft as a whole.
    `designer`: designs gains for a model; default: that of quad_tuning, where installed.
    `progress`: called with a line of text, or a tqdm; `seconds`: after which the search adds
    nothing more, as where `stop()` is true; the report says what was not tried. Raises
    BadInputError, one line, for wrong input.
    """
    from quad_sysid.effects import EFFECTS
    from quad_sysid.model.checked import checked
    from quad_sysid.pipeline.identify import Options
    from quad_sysid.pipeline.identify import identify as answers_of
    from quad_sysid.whole import whole_of

    for name, value in (('mass', mass), ('thrust', thrust)):
        if value is not None and not 0.0 < value < math.inf:
            raise BadInputError('identify', f'{name} must be a positive number', value)
    chosen = EFFECTS if effects is None else effects
    candidates = EFFECTS if effects is None and not extra_effects else checked(
        (*chosen, *extra_effects) if isinstance(chosen, list | tuple) else chosen,
        'identify: effects', EFFECTS)
    if base is not None and any(effect.name == base.name for effect in candidates):
        raise BadInputError('identify: base', 'has the name of an effect', base.name, 'rename it')
    show, limit = _listener(progress), _halt(seconds, stop)
    names, records = _request(flights, axes, {
        'u': u, 'y': y, 'dt': dt, 't': t, 'angle': angle, 'reference': reference,
        'signals': signals, 'units': units, 'gains': gains}, train, validate, show)
    missing = ''
    if designer is None:
        designer, missing = installed_designer()
    answers = answers_of(
        records,
        Options(axes=names, designer=designer, no_designer_because=missing, effects=candidates,
                base=base, halt=limit),
        show,
    )
    whole = None
    if records[0].units is None and base is None:
        models = {axis: answer.model for axis, answer in answers.items()
                  if answer.model is not None and answer.answered}
        whole = whole_of(models, records, mass, thrust)
    return Result(answers, tuple(record.source for record in records), inertia, whole)


def undetermined(base: Base, flights: Flights | None = None, axis: str = '',
                 **arrays: Any) -> tuple[str, ...]:
    """Parameters of a base that these data cannot determine, with their partners; before a fit.

    By the sensitivities of the innovations at the start values. Flights or arrays as `identify`.
    """
    from quad_sysid.model.data import axis_data
    from quad_sysid.own_base import lacking
    from quad_sysid.pipeline.identify import excited_axes
    from quad_sysid.pipeline.usable import together

    train, validate = (arrays.pop(name, None) for name in ('train', 'validate'))
    names, records = _request(flights, axis, arrays, train, validate, lambda _: None)
    unified = together(records)
    data = axis_data(unified, (names or excited_axes(unified))[0])
    return lacking(base, base.problem(data, unified[0].units))


def _request(flights: Any, axes: str | Sequence[str], arrays: Mapping[str, Any], train: Any,
             validate: Any, show: Callable[[str], None]) -> tuple[tuple[str, ...], list[Record]]:
    """The axes that are asked for, empty for those that the flights excite, and the records."""
    from quad_sysid.arrays import are_arrays, records_of

    if not isinstance(axes, str) and not all(isinstance(axis, str) for axis in axes):
        raise BadInputError('identify', 'axes must be names', type(axes).__name__,
                            'hand in arrays by their names: identify(u=…, y=…, dt=…)')
    names = (axes,) if isinstance(axes, str) and axes else tuple(axes)
    for axis in names:
        axis_of('identify', axis)
    if not are_arrays(flights) and all(array is None for array in arrays.values()):
        return names, _flown(flights, names, train, validate, show)
    if isinstance(flights, Record | str | Path) or len(names) > 1:
        raise BadInputError('identify', 'takes flights or arrays, not both, and arrays of one '
                            'axis', ', '.join(names) or str(flights), 'a flight holds its signals '
                            'and gains: hand in no more with it; of arrays name one axis')
    names = names or AXES[:1]
    return names, records_of(flights, **arrays, train=train, validate=validate, axis=names[0])


def _flown(flights: Any, axes: tuple[str, ...], train: Any, validate: Any,
           show: Callable[[str], None]) -> list[Record]:
    """The records of flights, with the segments that were asked for."""
    from quad_sysid.parts import part_of, with_parts

    every: list[Any] = [flights] if isinstance(flights, Record | str | Path) \
        else list(flights or ())
    if not every:
        raise BadInputError('identify', 'has no flight', repr(flights),
                            'name a bag, or hand in arrays: u=…, y=…, dt=…')
    records = []
    for k, flight in enumerate(every):
        if not isinstance(flight, Record):
            show(f'reading {flight}')
        record = flight if isinstance(flight, Record) else read_bag(flight)
        fitted, held_out = (part_of(part, k, len(every)) for part in (train, validate))
        spans = _is_span(fitted) and _is_span(held_out)
        records.append(split_segments(record, fitted, held_out, axes or None) if spans
                       else with_parts(record, record.time_s, axes or AXES, fitted, held_out))
    return records


def _is_span(part: object) -> bool:
    """Whether it is (start, end) in s, or nothing."""
    return part is None or (isinstance(part, tuple) and len(part) == 2
                            and not any(isinstance(entry, slice) for entry in part))


def _listener(progress: Any) -> Callable[[str], None]:
    """`progress` as a function of a line; a tqdm shows it and counts."""
    if callable(progress):
        return lambda line: (progress(line), None)[1]
    if hasattr(progress, 'set_description_str') and hasattr(progress, 'update'):
        return lambda line: (progress.set_description_str(line), progress.update(), None)[2]
    raise BadInputError('identify', 'progress must be a function of a line of text, or a tqdm',
                        type(progress).__name__)


def _halt(seconds: float | None, stop: Callable[[], bool]) -> Callable[[], str]:
    """Why the search may add nothing more; '' as long as it may."""
    if seconds is not None and not (math.isfinite(seconds) and seconds >= 0.0):
        raise BadInputError('identify', 'seconds must be a number of at least 0', seconds)
    end = math.inf if seconds is None else time.monotonic() + seconds

    def halted() -> str:
        if stop():
            return 'the search was stopped'
        return f'the search had {seconds:g} s' if time.monotonic() > end else ''

    return halted


def installed_designer(name: str = 'pid') -> tuple[Designer | None, str]:
    """The designer of this name, or None and why; another package's before quad_tuning's."""
    entries = entry_points(group=DESIGNERS)
    offered = {entry.value: entry for entry in entries if entry.name == name}
    own = [value for value in offered if not value.startswith('quad_tuning.')] or [*offered]
    if not own:
        names = ', '.join(sorted({entry.name for entry in entries})) or 'none'
        return None, (
            f'no designer {name!r} in the entry point group {DESIGNERS} (offered: {names}); '
            'install quad_tuning'
        )
    if len(own) > 1:
        return None, (f'several packages offer the designer {name!r} ({", ".join(own)}); '
                      'uninstall all but one')
    try:
        return offered[own[0]].load(), ''
    except Exception as error:  # noqa: BLE001 - the identification stands without gains
        return None, (f'the designer {own[0]} cannot be loaded: {type(error).__name__}: {error}; '
                      'mend its package or uninstall it')


def evaluate(model: AxisModel, flight: Record | str | Path) -> Evaluation:
    """Errors of an identified model on another flight, in the unit of its arrays, else rad/s.

    Raises BadInputError where the flight does not suit the model, NotInformativeError where it
    cannot test it.
    """
    from quad_sysid.pipeline.evaluate import evaluate as errors_of

    if not isinstance(model, AxisModel):
        raise BadInputError('evaluate', 'the model of an axis comes first', type(model).__name__,
                            'evaluate(result.model, flight); compare(z, model) for a black box')

    return errors_of(model, flight if isinstance(flight, Record) else read_bag(flight))


def read_model(path: str | Path, axis: str = '', effects: Sequence[Effect] = ()) -> Identified:
    """Read a model that `Result.save` wrote: model.json, or its folder.

    `axis` may be left out where the file has only one. `effects`: your own effects that the model
    may name, or `EFFECTS` with them. Raises BadInputError where the file or the axis is missing.
    """
    from quad_sysid.effects import EFFECTS
    from quad_sysid.model.checked import checked
    from quad_sysid.report.model_file import load_models, located, runnable

    place = located(path)
    models = load_models(place, checked(effects, 'read_model: effects', EFFECTS))
    if not axis and len(models) == 1:
        axis = next(iter(models))
    if axis not in models:
        raise BadInputError(f'{place}: axes', f'lacks {axis}' if axis else 'has several axes',
                            remedy=f'take one of {", ".join(models)}')
    return Identified(**vars(runnable({axis: models[axis]}, place)[axis]))


def model_of(model: object) -> Identified | Model:
    """The model of what a function of the public API takes for one: a result, a file, a model."""
    from quad_sysid.blackbox import Model

    if isinstance(model, Result):
        return model.model
    if isinstance(model, str | Path):
        return read_model(model)
    if isinstance(model, Identified | Model):
        return model
    if isinstance(model, AxisModel):
        return Identified(**vars(model))
    raise BadInputError('model', 'must be a model, a result or the path of a model.json',
                        type(model).__name__)


def separate(model: AxisModel | str, names: Sequence[str] = (), seconds: float = 60.0, *,
             effects: Sequence[Effect] = (), source: str = 'the model',
             progress: Callable[[str], None] = lambda _: None) -> Separation:
    """The flight of `seconds` s that separates two effects best, and how reliably.

    `model`: an identified axis, or the name of an axis for the paper's aircraft. `names`: two
    effects, or an effect and `nothing`; default: an effect of the model and its most probable
    rival. `effects`: your own effects that may be named. Raises BadInputError for unknown names,
    NotInformativeError where no flight shows either.
    """
    from quad_sysid.separation import design
    from quad_sysid.separation.flight import aircraft_of, effect_of, paper_aircraft

    if isinstance(model, str):
        return design.separate(paper_aircraft(model), _pair(names), seconds, progress=progress,
                               own_effects=effects)
    pair = _pair(names) if names else design.rivals_of(model)
    inside = next((name for name in pair if effect_of(model, name) is not None), '')
    aircraft = aircraft_of(model, inside, source)
    return design.separate(aircraft, pair, seconds, model, progress, effects)


def _pair(names: Sequence[str]) -> tuple[str, str]:
    if len(names) != 2:
        raise BadInputError('separate', 'needs the names of two effects', ' '.join(names) or None,
                            "such as ('coulomb_friction', 'nothing')")
    return names[0], names[1]
