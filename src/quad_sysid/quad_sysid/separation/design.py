"""The excitations that are compared, and their ranking for a pair of rivals.

Signals, bands and amplitudes are one table, within the excitation node's limits; to try another,
add a row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches

from threadpoolctl import threadpool_limits

from quad_sysid.axes import EVERY
from quad_sysid.effects import EFFECTS
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate.stored import library
from quad_sysid.model import AxisModel
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import ActingEffect, Effect, Part
from quad_sysid.separation.flight import Aircraft, Excitation, Flown, effect_of, fly
from quad_sysid.separation.measure import Apart, JudgedFlight, judged
from quad_sysid.signals import schedule
from quad_sysid.signals.guard import Limits
from quad_sysid.signals.schedule import AMPLITUDE_DEG
from quad_sysid.signals.waveforms import waveform

PLAIN = {'clock_s': 0.092, 'register_bits': 9, 'seed': 1}
"""design-excitation --band 0.1:20."""

Candidate = tuple[str, Mapping[str, float], tuple[float, ...]]

ATTITUDE: tuple[Candidate, ...] = (
    ('prbs', PLAIN, (6.0, 12.0, 18.0)),
    ('prbs', {'clock_s': 0.032, 'register_bits': 9, 'seed': 1}, (12.0, 20.0)),
    ('prbs', {'clock_s': 0.4, 'register_bits': 7, 'seed': 1}, (4.0, 12.0, 18.0)),
    ('square', {'period_s': 1.0}, (6.0, 18.0)),
    ('square', {'period_s': 3.0}, (4.0, 12.0, 18.0)),
    ('square', {'period_s': 8.0}, (4.0, 12.0, 18.0)),
    ('multisine', {'f0_hz': 0.1, 'f1_hz': 1.0, 'period_s': 20.0}, (6.0, 20.0)),
    ('multisine', {'f0_hz': 0.1, 'f1_hz': 4.0, 'period_s': 20.0}, (6.0, 20.0)),
    ('chirp', {'f0_hz': 0.05, 'f1_hz': 1.0, 'sweep_s': 20.0}, (12.0, 20.0)),
    ('chirp', {'f0_hz': 0.2, 'f1_hz': 8.0, 'sweep_s': 20.0}, (12.0, 20.0)),
    ('3211', {'unit_s': 0.3}, (12.0,)),
)
"""Signals on the attitude set-point, amplitudes in degrees."""
SLOW: tuple[Candidate, ...] = (
    ('multisine', {'f0_hz': 0.1, 'f1_hz': 0.1, 'period_s': 10.0}, (4.0, 20.0)),
    ('multisine', {'f0_hz': 0.05, 'f1_hz': 0.05, 'period_s': 20.0}, (20.0,)),
)
"""The same; a multisine of one line is a slow sine. One line does not identify the base, so a
plain PRBS precedes it, for the share BEFORE of the time."""
BEFORE = 1.0 / 3.0
CONTROL: tuple[Candidate, ...] = (
    ('prbs', {'clock_s': 0.02, 'register_bits': 9, 'seed': 1}, (0.02, 0.05)),
    ('prbs', {'clock_s': 0.06, 'register_bits': 9, 'seed': 1}, (0.02, 0.05)),
    ('chirp', {'f0_hz': 0.5, 'f1_hz': 15.0, 'sweep_s': 20.0}, (0.02, 0.05)),
)
"""Signals after C2, where the loop does not attenuate fast ones; normalised command."""

THROTTLE = {'throttle', 'battery', 'motors'}
OTHERS = {
    'other command', 'other rate', 'other angle', 'product of other rates', 'motors',
}


def plain_prbs(axis: str, seconds: float) -> Excitation:
    """The PRBS that is flown where nobody asks for more."""
    return Excitation(_part('attitude', 'prbs', PLAIN, AMPLITUDE_DEG, axis, seconds))


def with_pilot(usual: Excitation, signals: set[str]) -> Iterator[Excitation]:
    """Motion that the pilot may add where the rivals depend on it, the simplest first."""
    steps, stirs = bool(signals & THROTTLE), bool({s.rstrip(' 12') for s in signals} & OTHERS)
    for throttle, others in ((True, False), (False, True), (True, True)):
        if throttle <= steps and others <= stirs:
            yield replace(usual, throttle_steps=throttle, others_move=others)


def family(axis: str, seconds: float, pilot: Excitation) -> Iterator[Excitation]:
    """Every candidate but the plain PRBS, with the same additions by the `pilot`."""
    for kind, rows in (('attitude', ATTITUDE), ('control', CONTROL), ('slow', SLOW)):
        slow = kind == 'slow'
        before = plain_prbs(axis, BEFORE * seconds).part if slow else None
        rest = (1.0 - BEFORE) * seconds if slow else seconds
        injection = 'attitude' if slow else kind
        for signal, parameters, amplitudes in rows:
            for amplitude in amplitudes:
                part = _part(injection, signal, parameters, amplitude, axis, rest)
                if part != pilot.part:
                    yield replace(pilot, part=part, before=before)


def _part(injection: str, signal: str, parameters: Mapping[str, float], amplitude: float,
          axis: str, seconds: float) -> schedule.Part:
    shape = waveform(signal, dict(parameters), 'design-excitation')
    unit = schedule.AMPLITUDES[injection][1]
    return schedule.Part('train', seconds, signal, axis, injection, amplitude=unit * amplitude,
                         parameters=dict(parameters), waveform=shape)


NOTHING = 'nothing'
SIMULATED_S = 30.0
"""Longest simulated flight, s; longer ones only repeat it."""
MIN_DURATION_S, MAX_DURATION_S = 10.0, 600.0
"""A shorter flight determines no base; a longer one outlasts a battery."""
DETECTABLE_NATS = 12.0
"""Evidence, nats, at which a plain PRBS of the whole length just finds an effect: its prior costs
some 7, and 5 remain. A rival that the model does not contain is made that strong."""
PER_PARAMETER = 4.0
"""Additional cost of each parameter, for four at most."""
ANGLE_SHARE = 0.9
"""Share of the guard's angle that a flight may use."""
CERTAIN = 0.95
"""Probability with which a flight should tell two effects apart."""
NEARLY_BEST = 0.95
"""Share of the best figure from which a simpler flight is preferred."""
FITTED = 8
"""Number of candidates, best by linear scores, that are fitted."""

Progress = Callable[[str], None]
Names = tuple[str, str]


@dataclass(frozen=True)
class Rival:
    """An effect of a given strength, or nothing."""

    name: str
    acting: ActingEffect | None = None
    variants: tuple[Effect, ...] = ()
    """Every effect of this name."""

    def words(self) -> str:
        """Name and strength."""
        if self.acting is None or self.acting.effect.kind == 'shape':
            return self.name
        read = self.acting.effect.readable(self.acting.p, self.acting.part.settings)
        values = (f'{name} {value:.3g} {unit if unit != "1" else ""}'.strip()
                  for name, (value, unit) in read.items())
        return f'{self.name} ({", ".join(values)})'

    def parts(self, data: AxisData) -> list[Part]:
        """Variants of the effect, as an identification would try them on this flight."""
        settings = ((effect, effect.prepare(data)) for effect in self.variants)
        return [Part(effect, s) for effect, s in settings if not isinstance(s, str)]


@dataclass(frozen=True)
class Row:
    """One judged candidate flight."""

    excitation: Excitation
    first: Apart | None
    """The first rival is true, the second fitted; None where the first is nothing."""
    second: Apart | None
    peak_angle: float
    """rad, the larger of both."""
    rate_rms: float

    @property
    def worst(self) -> Apart:
        """The harder of the two cases."""
        powers = [power for power in (self.first, self.second) if power is not None]
        return min(powers, key=lambda power: power.nats)


@dataclass(frozen=True)
class Separation:
    """The ranked flights for a pair of rivals."""

    aircraft: Aircraft
    first: Rival
    second: Rival
    seconds: float
    """Length of training for the figures, s."""
    rows: tuple[Row, ...]
    """Best first."""
    plain: Row
    """The PRBS that is flown where nobody asks for more."""
    tried: int
    refused: int
    """Candidates beyond the guard's angle, or with too little motion to identify the base."""

    @property
    def best(self) -> Row:
        """The flight to fly."""
        return self.rows[0]


def rivals_of(model: AxisModel) -> Names:
    """The effect of a model with the most probable rival, and that rival.

    Raises NotInformativeError where no effect has one.
    """
    rivals = [(p, e.name, name) for e in model.effects for name, p in e.listed_rivals if p > 0.0]
    if not rivals:
        raise NotInformativeError(
            f'{model.axis}: no effect of this model has a rival of any probability; '
            'name the two: --separate A B'
        )
    _, effect, rival = max(rivals)
    return effect, rival


def nearest(models: Mapping[str, AxisModel]) -> AxisModel:
    """The axis whose effects have the most probable rival; the first where none has any.

    Raises BadInputError where none of them turns.
    """
    turning = [model for model in models.values() if EVERY[model.axis].turns]
    if not turning:
        raise BadInputError('--model', 'must hold roll, pitch or yaw: a flight is designed to '
                            'separate effects of these', ', '.join(models))
    return max(turning, key=lambda model: max(
        (p for e in model.effects for _, p in e.listed_rivals), default=-1.0
    ))


def variants(name: str, effects: Sequence[Effect] = EFFECTS) -> tuple[Effect, ...]:
    """Every effect of this name; none for `nothing`."""
    return tuple(e for e in effects if e.name == name)


def separate(aircraft: Aircraft, names: Names, seconds: float = 60.0,
             model: AxisModel | None = None, progress: Progress = lambda _: None,
             own_effects: Sequence[Effect] = ()) -> Separation:
    """Rank flights of `seconds` by how well they separate two effects (one may be `nothing`).

    Strengths come from `model` where it has the effect; another effect is made just strong enough
    to be detected. `own` are effects of the caller that may be named too. Raises BadInputError for
    unknown names or a length out of range, NotInformativeError where no safe flight shows either.
    """
    effects = library((*own_effects, *(model.own_effects if model else ())))
    _check(names, seconds, effects)
    with threadpool_limits(limits=1):
        return _separate(aircraft, names, seconds, model, progress, effects)


def _separate(aircraft: Aircraft, names: Names, seconds: float, model: AxisModel | None,
              progress: Progress, effects: Sequence[Effect]) -> Separation:
    length = min(seconds, SIMULATED_S)
    signals = {s for name in names for e in variants(name, effects) for s in e.signals}
    usual = plain_prbs(aircraft.axis, length)
    helped = list(with_pilot(usual, signals))
    rich = helped[-1] if helped else usual
    first, second = _sized(aircraft, names, model, rich, DETECTABLE_NATS * length / seconds,
                           effects)
    flights = _Flights(aircraft, first, second)
    plain = flights.rows([usual])[0]
    if plain is None:
        raise NotInformativeError(
            f'{aircraft.axis}: even the plain PRBS goes beyond the angle limit or moves nothing; '
            'check the gains and the model'
        )
    pilot = _pilot(plain, flights.rows(helped))
    progress(f'{aircraft.axis}: the candidate flights')
    candidates = list(family(aircraft.axis, length, pilot.excitation))
    linear = [row for row in flights.rows(candidates, progress) if row is not None]
    rejected = len(candidates) - len(linear)
    linear += [pilot] * (pilot is not plain)
    linear.sort(key=lambda row: -row.worst.nats)
    progress(f'{aircraft.axis}: the best of them')
    plain = flights.fitted(plain)
    rows = [plain, *(flights.fitted(row) for row in linear[:FITTED])]
    rows.sort(key=lambda row: -row.worst.nats)
    if rows[0].worst.nats <= 0.0:
        raise NotInformativeError(
            f'no flight within the limits shows {names[0]} or {names[1]} on {aircraft.axis}'
        )
    if plain.worst.score > NEARLY_BEST * rows[0].worst.score:
        rows.sort(key=lambda row: row is not plain)
    return Separation(aircraft, first, second, seconds, tuple(rows), plain, len(candidates),
                      rejected)


def _pilot(plain: Row, helped: Sequence[Row | None]) -> Row:
    """The plain PRBS, with the pilot's additions where they help."""
    rated = [row for row in helped if row is not None]
    best = max([plain, *rated], key=lambda row: row.worst.nats)
    return next(
        row for row in (plain, *rated, best)
        if row is best or row.worst.score > NEARLY_BEST * best.worst.score
    )


def _check(names: Names, seconds: float, effects: Sequence[Effect]) -> None:
    all_names = [NOTHING, *dict.fromkeys(e.name for e in effects)]
    for name in names:
        if name not in all_names:
            near = [candidate for candidate in all_names if name in candidate][:3]
            near = near or get_close_matches(name, all_names)
            raise BadInputError('--separate', 'unknown effect', repr(name), (
                f'do you mean {" or ".join(near)}? ' if near else '')
                + 'docs/what_is_missing.md lists the effects')
    if names[0] == names[1]:
        raise BadInputError('--separate', 'needs two different effects', ' '.join(names))
    if not MIN_DURATION_S <= seconds <= MAX_DURATION_S:
        raise BadInputError('--seconds', f'must be from {MIN_DURATION_S:g} to {MAX_DURATION_S:g}',
                            seconds)


def _sized(aircraft: Aircraft, names: Names, model: AxisModel | None, rich: Excitation,
           target_nats: float, effects: Sequence[Effect]) -> tuple[Rival, Rival]:
    """Both rivals with their strengths; an unknown one gets as much evidence as the known."""
    rich_flight = judged(aircraft, fly(aircraft, aircraft.acting, [rich])[0].data)
    placed = [None if model is None else effect_of(model, name) for name in names]
    evidence = max((rich_flight.trace(acting) for acting in placed if acting is not None),
                   default=target_nats)
    out = []
    for name, known_effect in zip(names, placed, strict=True):
        acting = known_effect
        if acting is None and name != NOTHING:
            part = _prepared(name, rich_flight.problem.data, effects)
            price = PER_PARAMETER * min(len(part.effect.parameters), 4)
            acting = rich_flight.sized(part, max(evidence, target_nats + price))
        out.append(Rival(name, acting, variants(name, effects)))
    return out[0], out[1]


def _prepared(name: str, data: AxisData, effects: Sequence[Effect]) -> Part:
    """The first variant that a flight can show, with its settings."""
    reason = ''
    for effect in variants(name, effects):
        settings = effect.prepare(data)
        if not isinstance(settings, str):
            return Part(effect, settings)
        reason = settings
    raise BadInputError('--separate', f'{name} cannot be shown on {data.axis}', reason)


class _Flights:
    """Flights with either rival true, each simulated once."""

    def __init__(self, aircraft: Aircraft, first: Rival, second: Rival) -> None:
        self.aircraft, self.rivals = aircraft, (first, second)
        self.judged_pairs: dict[int, tuple[JudgedFlight, JudgedFlight]] = {}

    def rows(self, excitations: Sequence[Excitation],
             progress: Progress = lambda _: None) -> list[Row | None]:
        """Each excitation by linear scores; None where it is unsafe or moves too little."""
        if not excitations:
            return []
        flights = [
            fly(self.aircraft, (*self.aircraft.acting, *([r.acting] if r.acting else [])),
                excitations)
            for r in self.rivals
        ]
        out: list[Row | None] = []
        for number, (excitation, *pair) in enumerate(zip(excitations, *flights, strict=True), 1):
            progress(f'{self.aircraft.axis}: flight {number} of {len(excitations)}')
            out.append(self._row(excitation, pair))
        return out

    def _row(self, excitation: Excitation, pair: Sequence[Flown]) -> Row | None:
        peak = max(flight.peak_angle for flight in pair)
        if not peak <= ANGLE_SHARE * Limits().angle_rad:
            return None
        pair_judged = judged(self.aircraft, pair[0].data), judged(self.aircraft, pair[1].data)
        if not (pair_judged[0].identified and pair_judged[1].identified):
            return None
        self.judged_pairs[id(excitation)] = pair_judged
        row = Row(excitation, None, None, peak, max(flight.rate_rms for flight in pair))
        return self._weighed(row, JudgedFlight.linear)

    def fitted(self, row: Row) -> Row:
        """The same row, judged by fits."""
        return self._weighed(row, JudgedFlight.fitted)

    def _weighed(self, row: Row, evidence: Callable[[JudgedFlight, Sequence[Part]], float]) -> Row:
        outcomes: list[Apart | None] = []
        for flight, true, other in zip(self.judged_pairs[id(row.excitation)], self.rivals,
                                       self.rivals[::-1], strict=True):
            data = flight.problem.data
            if true.acting is None:
                outcomes.append(None)
                continue
            nats = evidence(flight, [true.acting.part])
            other_nats = evidence(flight, other.parts(data))
            seconds = sum(b - a for a, b in flight.problem.spans) * data.dt
            share = 1.0 if nats <= 0.0 else min(max(other_nats / nats, 0.0), 1.0)
            outcomes.append(Apart(nats - other_nats, share, seconds))
        return replace(row, first=outcomes[0], second=outcomes[1])
