"""Compare every candidate flight by how surely it tells two rivals apart; the order, and why."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from quad_sysid.effects.shapes import NAMED_CURVES, SHAPES
from quad_sysid.effects.table import EFFECTS
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Effect, Prepared, Settings, Structure
from quad_sysid.model import AxisModel
from quad_sysid.separation import family
from quad_sysid.separation.aircraft import Aircraft, effect_of
from quad_sysid.separation.flight import Excitation, Flown, fly
from quad_sysid.separation.measure import Apart, Noise, apart, base_growth, informative, noise_of
from quad_sysid.separation.strength import GROWTH, Rival, sized, theta_with
from quad_sysid.signals.guard import Limits

NOTHING = 'nothing'
SIMULATED_S = 44.0
"""Flights are simulated this long at most; longer ones show the same more often."""
SHORTEST_S = 10.0
ANGLE_SHARE = 0.9
"""A flight may use this share of the guard's angle."""
CERTAIN = 0.95
WORTH_IT = 0.95
"""What is this near to the best is preferred where it is simpler to fly."""

Progress = Callable[[str], None]
Names = tuple[str, str]


@dataclass(frozen=True)
class Row:
    """One candidate flight, judged."""

    excitation: Excitation
    first: Apart | None
    """The first rival true, the second fitted; None where the second contains the first."""
    second: Apart | None
    peak_angle: float
    """rad, the larger of both."""
    rate_rms: float

    @property
    def worst(self) -> Apart:
        """The harder of both ways."""
        known = [one for one in (self.first, self.second) if one is not None]
        return min(known, key=lambda one: one.score)


@dataclass(frozen=True)
class Separation:
    """The ranked flights for a pair of rivals."""

    aircraft: Aircraft
    first: Rival
    second: Rival
    seconds: float
    """Length of training that the figures are for."""
    rows: tuple[Row, ...]
    """Best first."""
    plain: Row
    """The PRBS that is flown where nobody asks for more."""
    refused: int
    """Candidates that went beyond the guard's angle, or moved too little to tell the base."""

    @property
    def best(self) -> Row:
        """What should be flown."""
        return self.rows[0]


def rivals_of(model: AxisModel) -> Names:
    """The effect of a model with the most probable rival, and that rival.

    Raises NotInformativeError where no effect has one.
    """
    found = [(p, e.name, name) for e in model.effects for name, p in e.rivals if p > 0.0]
    if not found:
        raise NotInformativeError(
            f'{model.axis}: no effect of this model has a rival that came near; '
            'name the two: --separate A B'
        )
    _, effect, rival = max(found)
    return effect, rival


def nearest(models: Mapping[str, AxisModel]) -> AxisModel:
    """The axis whose effects have the most probable rival; the first where none has any."""

    def nearness(model: AxisModel) -> float:
        return max((p for e in model.effects for _, p in e.rivals), default=-1.0)

    return max(models.values(), key=nearness)


def separate(
    aircraft: Aircraft, names: Names, seconds: float = 60.0, model: AxisModel | None = None,
    progress: Progress = lambda _: None,
) -> Separation:
    """Rank the flights of `seconds` that tell the two effects apart (either may be `nothing`).

    Strengths come from `model` where it has the effect, else as strong as is just found today.
    Raises BadInputError for unknown names or a length that is too short, NotInformativeError
    where no safe flight shows either effect.
    """
    _check(names, seconds)
    with threadpool_limits(limits=1):
        return _separate(aircraft, names, seconds, model, progress)


def _separate(
    aircraft: Aircraft, names: Names, seconds: float, model: AxisModel | None, progress: Progress
) -> Separation:
    length = min(seconds, SIMULATED_S)
    signals = {s for name in names for e in variants(name) for s in e.signals}
    usual = family.plain(aircraft.axis, length)
    rich = replace(
        usual, throttle_steps=bool(signals & family.THROTTLE),
        others_move=bool(signals & family.OTHERS),
    )
    seen = fly(aircraft, aircraft.structure, aircraft.theta, rich)
    noise = noise_of(aircraft, seen.data)
    first, second = _sized(aircraft, names, model, rich, seen, noise)

    def judged(excitation: Excitation) -> Row | None:
        return _row(aircraft, first, second, excitation, noise)

    plain = judged(usual)
    if plain is None:
        raise NotInformativeError(
            f'{aircraft.axis}: even the plain PRBS goes beyond the angle limit or moves nothing; '
            'check the gains and the model'
        )
    pilot = _pilot(plain, [judged(e) for e in family.with_pilot(usual, signals)])
    candidates = list(family.family(aircraft.axis, length, pilot.excitation))
    rows = [plain] if pilot is plain else [plain, pilot]
    for number, excitation in enumerate(candidates, 1):
        progress(f'{aircraft.axis}: flight {number} of {len(candidates)}')
        row = judged(excitation)
        if row is not None:
            rows.append(row)
    rows.sort(key=lambda row: -row.worst.score)
    if rows[0].worst.score <= 0.0:
        raise NotInformativeError(
            f'no flight within the limits shows {names[0]} or {names[1]} on {aircraft.axis}'
        )
    if plain.worst.score > WORTH_IT * rows[0].worst.score:
        rows.sort(key=lambda row: row is not plain)
    refused = len(candidates) - len(rows) + (1 if pilot is plain else 2)
    return Separation(aircraft, first, second, seconds, tuple(rows), plain, refused)


def _pilot(plain: Row, helped: Sequence[Row | None]) -> Row:
    """The plain PRBS with what the pilot should do besides; itself where that hardly helps."""
    known = [row for row in helped if row is not None]
    best = max(known, key=lambda row: row.worst.score, default=plain)
    enough = [row for row in known if row.worst.score > WORTH_IT * best.worst.score]
    return plain if plain.worst.score > WORTH_IT * best.worst.score else enough[0]


def variants(name: str) -> tuple[Effect, ...]:
    """Every entry of the tables with this name; none for `nothing`."""
    return tuple(e for e in EFFECTS + SHAPES if e.name == name)


def _check(names: Names, seconds: float) -> None:
    known = [NOTHING, *dict.fromkeys(e.name for e in EFFECTS + SHAPES)]
    for name in names:
        if name not in known:
            raise BadInputError(
                '--separate', 'unknown effect', repr(name), f'use {", ".join(known)}'
            )
    if names[0] == names[1]:
        raise BadInputError('--separate', 'needs two different effects', ' '.join(names))
    if not SHORTEST_S <= seconds <= 600.0:
        raise BadInputError('--seconds', f'must be from {SHORTEST_S:g} to 600', seconds)


def _sized(
    aircraft: Aircraft, names: Names, model: AxisModel | None, rich: Excitation, seen: Flown,
    noise: Noise,
) -> tuple[Rival, Rival]:
    """Both rivals with their strengths; where one is known, the other errs as much as it."""
    given = [_given(model, name) for name in names]
    settings = [
        None if rival is not None or name == NOTHING else _settings(name, seen.data)
        for rival, name in zip(given, names, strict=True)
    ]

    def growth(effect: Effect, of: Settings, parameters: tuple[float, ...]) -> float:
        structure = aircraft.structure.with_effect(effect, of)
        theta = np.concatenate([aircraft.theta, np.array(parameters)])
        flown = fly(aircraft, structure, theta, rich)
        if not np.isfinite(flown.peak_angle):
            return math.inf
        return base_growth(flown.data, noise, aircraft.structure, aircraft.theta)

    wanted = GROWTH
    for rival in given:
        if rival is not None and rival.effect is not None and rival.settings is not None:
            wanted = max(growth(rival.effect, rival.settings, rival.parameters), 1.01)
    out = []
    for name, rival, put in zip(names, given, settings, strict=True):
        if rival is not None:
            out.append(rival)
        elif put is None:
            out.append(Rival(NOTHING))
        else:
            effect, own = put
            parameters = sized(
                effect, seen.data, lambda p, e=effect, s=own: growth(e, s, p),  # type: ignore[misc]
                wanted,
            )
            out.append(Rival(name, effect, own, parameters))
    return out[0], out[1]


def _given(model: AxisModel | None, name: str) -> Rival | None:
    """The rival as a model has it, if it does."""
    found = None if model is None else effect_of(model, name)
    if found is None:
        return None
    structure, theta = found
    return Rival(name, structure.effects[0], structure.settings[0], tuple(theta.tolist()))


def _settings(name: str, data: AxisData) -> Prepared:
    """The first variant that a flight can show, with its settings."""
    reason = ''
    for effect in variants(name):
        settings = effect.prepare(data) if effect.prepare else {}
        if not isinstance(settings, str):
            return effect, settings
        reason = settings
    raise BadInputError('--separate', f'{name} cannot be shown on {data.axis}', reason)


def _row(
    aircraft: Aircraft, first: Rival, second: Rival, excitation: Excitation, noise: Noise
) -> Row | None:
    """One flight with either rival true; None where it is not safe or moves too little."""
    flights = [_flown(aircraft, rival, excitation) for rival in (first, second)]
    peak = max(flown.peak_angle for flown in flights)
    safe = peak <= ANGLE_SHARE * Limits().angle_rad
    if not safe or not all(informative(flown.data, noise) for flown in flights):
        return None
    found = [
        _one_way(aircraft, true, other, flown, noise)
        for true, other, flown in zip(
            (first, second), (second, first), flights, strict=True
        )
    ]
    return Row(excitation, found[0], found[1], peak, max(f.rate_rms for f in flights))


def _flown(aircraft: Aircraft, rival: Rival, excitation: Excitation) -> Flown:
    return fly(
        aircraft, structure_with(aircraft, rival), theta_with(aircraft.theta, rival), excitation
    )


def structure_with(aircraft: Aircraft, rival: Rival) -> Structure:
    """The aircraft's structure with the rival on top."""
    if rival.effect is None or rival.settings is None:
        return aircraft.structure
    return aircraft.structure.with_effect(rival.effect, rival.settings)


def _one_way(
    aircraft: Aircraft, true: Rival, other: Rival, flown: Flown, noise: Noise
) -> Apart | None:
    """How far `other` stays behind `true`; None where it contains it, as anything does nothing."""
    if true.effect is None or _contains(other, true):
        return None
    return apart(
        flown.data, noise,
        (structure_with(aircraft, true), theta_with(aircraft.theta, true)),
        (aircraft.structure, aircraft.theta), _prepared(other, flown.data),
    )


def _prepared(rival: Rival, data: AxisData) -> tuple[Prepared, ...]:
    """The rival's variants as identification would try them on this flight."""
    out: list[Prepared] = []
    for effect in variants(rival.name):
        settings = effect.prepare(data) if effect.prepare else {}
        if not isinstance(settings, str):
            out.append((effect, settings))
    return tuple(out)


def _contains(other: Rival, true: Rival) -> bool:
    """Whether a curve holds a named effect of its own signal."""
    if other.effect is None or true.effect is None or other.effect.kind != 'shape':
        return False
    same = set(other.effect.signals) == set(true.effect.signals)
    return same and (true.name in NAMED_CURVES or true.name in ('dead_zone', 'battery_sag'))
