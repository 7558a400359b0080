"""What each motor, or an axis' command, does to the axis by the motion alone: all signs are tried.

Pure array maths; it knows no frame, no order and no file. A pattern gives each motor +, - or 0;
the share of the axis' angular acceleration (or, of a rig that hangs, of its angle) which the
signed sum of the commands explains is compared over all patterns, delays and lags.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import Craft
from quad_sysid.foresight import predictive
from quad_sysid.record import finite_runs

LAGS_S = (0.0, 0.01, 0.02, 0.04, 0.08, 0.15)
DELAYS_S = (0.0, 0.005, 0.01, 0.02, 0.03, 0.04)
"""Lags and delays of motors, airframes and telemetry that are tried; the best pair counts."""
STEP_S = 0.02
"""Span of the rate's change: long against gyro noise, short against a motor's lag."""
CRASH = 5.0
"""Robust standard deviations to which angular accelerations are limited, so that a crash, a hand
or a landing does not outweigh the whole flight."""
BLOCKS = 8
"""Parts of the recording in which the pattern is compared with its nearest rival."""
MAX_BLOCKS = 0.75
"""Share of these parts that a certain pattern wins."""
MIN_SHARE = {'angular acceleration': 0.02, 'angle': 0.8}
"""Least explained share; larger for an angle, which in flight follows the motors by chance."""
FULL_PREFERRED = 1.3
"""Factor by which idle motors must explain more to be accepted, since nonlinear thrust and limits
let some motors seem weaker."""
COMPARABLE, NEAR = 0.85, 0.6
"""Patterns whose signals correlate by NEAR are not rivals. If they also explain the share
COMPARABLE of the best, the data cannot separate them, and the one in which the motors moved most
counts."""
CLEARLY_LESS = 0.5
"""Share of the best pattern's explanation below which a mixer is in doubt."""
REVERSED_SHARE = 0.2
"""Least share with which a command is called reversed: a slow motion may have any phase to it."""
EXCHANGED = 0.5
"""Least share of an axis' response that another axis' command explains to be taken for its own."""
MAX_ROWS = 200_000
"""At most so many samples are compared, in as many parts as there are blocks."""
MAX_MOTORS = 8
"""All patterns of their signs are compared, whose number grows as a power."""


@dataclass(frozen=True)
class Pattern:
    """The signs with which the motors turn one axis."""

    axis: str
    signs: tuple[int, ...]
    """Sign of each motor in the given order: 1, -1 or 0; of the axis' command where it is one."""
    share: float
    """Share of the response's variance that the signed sum explains, 0..1."""
    rival_share: float
    """Share of the best other pattern."""
    certain: bool
    """Whether it is clearly better than every other pattern."""
    response: str
    """`angular acceleration` or `angle`."""

    @property
    def text(self) -> str:
        """The signs as they are written: `- - + +`."""
        return ' '.join('+' if s > 0 else '-' if s < 0 else '0' for s in self.signs)

    @property
    def sentence(self) -> str:
        """One line on what the motors, or the command, do to the axis."""
        sure = '' if self.certain else ', not certain'
        what, rival = f'motors on {self.axis}: {self.text} explain', 'next best'
        if len(self.signs) == 1:
            what, rival = f'command on {self.axis}: {self.text} explains', 'the other sign'
        return (f'{what} {100.0 * self.share:.3g} % of the {self.response} ({rival} '
                f'{100.0 * self.rival_share:.2g} %{sure})')


@dataclass(frozen=True)
class _Response:
    """Sums over the rows of each block, enough for the share of any signed sum of motors."""

    name: str
    gram: FloatArray
    """(d, b, n, n) products of the motors, for d pairs of delay and lag, in b blocks."""
    cross: FloatArray
    """(d, b, n) products of motors and response."""
    power: FloatArray
    """(d, b) of the response."""

    def shares(self, signs: FloatArray) -> FloatArray:
        """(d, p) share that p patterns (p, n) explain over all blocks; 0 for a negative gain."""
        return _share(signs, self.gram.sum(axis=1), self.cross.sum(axis=1), self.power.sum(axis=1))


def _share(
    signs: FloatArray, gram: FloatArray, cross: FloatArray, power: FloatArray
) -> FloatArray:
    """(…, p): share of the response's power that each signed sum explains."""
    fitted = np.maximum(np.einsum('pn,...n->...p', signs, cross), 0.0)
    spread = np.einsum('pn,...nm,pm->...p', signs, gram, signs)
    total = spread * power[..., None]
    share = np.divide(fitted**2, total, out=np.zeros_like(fitted), where=total > 1e-12)
    return np.asarray(share, dtype=np.float64)


def patterns_of(
    rates: FloatArray, motors: FloatArray, dt: float, angles: FloatArray | None = None
) -> tuple[Pattern, ...]:
    """The best pattern of each axis that moves; empty where nothing can be compared.

    rates (n, 3) rad/s, motors (n, k) normalised with k of 2 to 8, angles (n, 3) rad, dt in s; NaN
    where a sample is missing. An axis of constant zeros counts as not measured.
    """
    if not 2 <= motors.shape[1] <= MAX_MOTORS:
        return ()
    rates, motors = _parts(rates), _parts(motors)
    angles = None if angles is None else _parts(angles)
    responses = {
        axis: tuple(_responses(rates[:, i], motors, dt, None if angles is None else angles[:, i]))
        for i, axis in enumerate(AXES)
    }
    return _best_of(responses, idle=('roll', 'pitch'))  # as motors of a plus frame are


def commands_of(
    rates: FloatArray, commands: FloatArray, dt: float, angles: FloatArray | None = None
) -> tuple[Pattern, ...]:
    """The sign with which the command of each axis that moves turns it; as patterns_of.

    commands (n, 3), normalised.
    """
    patterns: list[Pattern] = []
    rates, commands = _parts(rates), _parts(commands)
    angles = None if angles is None else _parts(angles)
    for i, axis in enumerate(AXES):
        pair = np.column_stack([commands[:, i], -commands[:, i]])
        angle = None if angles is None else angles[:, i]
        if np.nanstd(commands[:, i]) > 0.0:
            patterns += _best_of({axis: tuple(_responses(rates[:, i], pair, dt, angle))}, idle=())
    return confirmed(tuple(replace(p, signs=p.signs[:1]) for p in patterns), rates, commands, dt)


def _parts(values: FloatArray) -> FloatArray:
    """Very long arrays (n, k) reduced to parts spread over them, with NaN rows between."""
    if len(values) <= MAX_ROWS:
        return values
    size = MAX_ROWS // BLOCKS
    gap = np.full((1, values.shape[1]), np.nan)
    return np.concatenate([row for part in np.array_split(values, BLOCKS)
                           for row in (part[:size], gap)])


def confirmed(
    patterns: Sequence[Pattern], rates: FloatArray, drives: FloatArray, dt: float
) -> tuple[Pattern, ...]:
    """The patterns, certain only where the drives (n, k) predict the axis' rate (foresight.py).

    Otherwise the feedback alone joins them: the noise of a held axis is in its motors too.
    """

    def predicted(pattern: Pattern) -> bool:
        rate = rates[:, AXES.index(pattern.axis)]
        is_finite = np.isfinite(rate) & np.isfinite(drives).all(axis=1)
        return predictive(rate, drives, finite_runs(is_finite, (0, is_finite.size)), dt)

    return tuple(
        replace(p, certain=p.certain and (p.response == 'angle' or predicted(p))) for p in patterns
    )


def opposite(patterns: Sequence[Pattern], remedies: Mapping[str, str]) -> list[str]:
    """A line, with the axis' remedy, for each command (commands_of) that turns the wrong way."""
    remedy = 'turn the sign of its command where it is made or imported (--unit COLUMN=-1)'
    return [
        f'{p.axis}: command and rate have opposite signs: reversed, the command explains '
        f'{100.0 * p.share:.3g} % of the {p.response}, as it is {100.0 * p.rival_share:.2g} %: '
        + remedies.get(p.axis, remedy)
        for p in patterns if p.certain and p.signs == (-1,) and p.share >= REVERSED_SHARE
    ]


def exchanged(patterns: Sequence[Pattern], rates: FloatArray, commands: FloatArray,
              dt: float) -> list[str]:
    """A line for each axis that follows another axis' command and not its own (commands_of)."""
    rates, commands = _parts(rates), _parts(commands)
    out = []
    for i, axis in enumerate(AXES):
        own = max((p.share for p in patterns if p.axis == axis), default=0.0)
        others = {other: share_of(np.ones(1), rates[:, i], commands[:, [j]], dt)
                  for j, other in enumerate(AXES)
                  if j != i and np.nanstd(commands[:, j]) > 0.0 and np.nanstd(rates[:, i]) > 0.0}
        best = max(others, key=lambda other: others[other], default='')
        if best and others[best] >= EXCHANGED and own < REVERSED_SHARE * others[best]:
            out.append(f'{axis}: the command of {best} explains {100.0 * others[best]:.3g} % of '
                       f'the angular acceleration, its own {100.0 * own:.2g} %: are the columns '
                       'of rates or commands exchanged?')
    return out


def _best_of(
    responses: Mapping[str, tuple[_Response, ...]], idle: tuple[str, ...]
) -> tuple[Pattern, ...]:
    """The best pattern of each axis that moves; motors may be idle for the axes of `idle`."""
    patterns_of_axes = [[_best(axis, response, idle=axis in idle) for response in candidates]
                        for axis, candidates in responses.items()]
    return tuple(
        max(patterns, key=lambda p: (p.certain, p.response != 'angle', p.share))
        for patterns in patterns_of_axes if patterns
    )


def share_of(
    weights: FloatArray, rate: FloatArray, motors: FloatArray, dt: float,
    response: str = 'angular acceleration', angle: FloatArray | None = None,
) -> float:
    """Share of one axis' response that motors (n, k) weighted by (k,) explain; rate (n,) rad/s."""
    return max((float(r.shares(weights[None]).max())
                for r in _responses(rate, motors, dt, angle) if r.name == response), default=0.0)


def places(patterns: Sequence[Pattern], craft: Craft) -> tuple[dict[str, str], list[str]]:
    """Position of each motor, and differences from the craft's layout, in words.

    From certain patterns only, with the function of the polarity check in flight.
    """
    certain = [p for p in patterns if p.certain and len(p.signs) == craft.count]
    return craft.where_motors_are({
        f'motor_{k + 1}': {p.axis: p.signs[k] for p in certain if p.signs[k]}
        for k in range(craft.count)
    })


def doubts(
    name: str, matrix: FloatArray, patterns: Sequence[Pattern], rates: FloatArray,
    motors: FloatArray, dt: float, angles: FloatArray | None = None,
) -> list[str]:
    """A line for each axis on which a mixer (4, k) explains clearly less than its pattern."""
    out = []
    for pattern in patterns:
        axis = AXES.index(pattern.axis)
        share = share_of(matrix[1 + axis], rates[:, axis], motors, dt, pattern.response,
                         None if angles is None else angles[:, axis])
        if pattern.certain and share < CLEARLY_LESS * pattern.share:
            out.append(
                f'{name} explains {100.0 * share:.2g} % of the {pattern.response} on '
                f'{pattern.axis}, the motors as {pattern.text} explain '
                f'{100.0 * pattern.share:.3g} %: import with --mixer auto, or check the order'
            )
    return out


@cache
def _patterns(n: int, *, idle: bool) -> FloatArray:
    """(p, n) patterns with as many + as -; with `idle` two of four or six motors may be 0."""
    count = {0, 2} if idle and n in (4, 6) else {n % 2}
    return np.array([
        s for s in product((-1, 0, 1), repeat=n) if not sum(s) and s.count(0) in count
    ], dtype=float)


def _best(axis: str, response: _Response, *, idle: bool) -> Pattern:
    signs = _patterns(response.cross.shape[-1], idle=idle)
    shares = response.shares(signs)
    setting = int(np.unravel_index(int(np.argmax(shares)), shares.shape)[0])
    spread = signs @ response.gram[setting].sum(axis=0) @ signs.T
    driven = np.diag(spread) / (signs**2).sum(axis=1)
    size = np.sqrt(np.maximum(np.diag(spread), 1e-300))
    is_complete = (signs != 0.0).all(axis=1)
    explained = shares[setting]
    complete_share = explained[is_complete].max(initial=0.0)
    if FULL_PREFERRED * complete_share < explained.max() and not is_complete.all():
        is_complete = ~is_complete
    best = int(np.argmax(np.where(is_complete, explained, -1.0)))
    comparable = is_complete & (explained >= COMPARABLE * explained[best]) & (
        spread[best] > NEAR * size[best] * size)
    first = int(np.argmax(np.where(comparable, driven, -1.0)))
    near = spread[first] > NEAR * size[first] * size
    rivals = np.where(near, -1.0, shares.max(axis=0))  # one that explains nothing is one, too
    rival = int(np.argmax(rivals))
    by_block = _share(signs[[first, rival]], response.gram[setting], response.cross[setting],
                      response.power[setting])
    won = float(np.mean(by_block[:, 0] > by_block[:, 1]))
    share, other = float(shares[setting, first]), max(float(rivals[rival]), 0.0)
    return Pattern(
        axis, tuple(int(s) for s in signs[first]), share, other,
        certain=share >= MIN_SHARE[response.name] and won >= MAX_BLOCKS,
        response=response.name,
    )


def _responses(
    rate: FloatArray, motors: FloatArray, dt: float, angle: FloatArray | None
) -> Iterator[_Response]:
    """Sums for the angular acceleration and, where there is one that moves, for the angle."""
    step = max(1, round(STEP_S / dt))
    if len(rate) <= BLOCKS * (step + 1) or np.unique(rate[np.isfinite(rate)]).size < 2:
        return
    change = np.full(len(rate), np.nan)
    change[:-step] = (rate[step:] - rate[:-step]) / (step * dt)
    usual = 0.0 if np.isnan(change).all() else \
        1.4826 * float(np.nanmedian(np.abs(change - np.nanmedian(change))))
    if usual > 0.0:
        change = np.clip(change, -CRASH * usual, CRASH * usual)
    yield _sums('angular acceleration', change, motors, dt, step)
    if angle is not None and np.nanstd(angle) > 0.0:
        yield _sums('angle', angle, motors, dt, 1)


def _sums(
    name: str, response: FloatArray, motors: FloatArray, dt: float, step: int
) -> _Response:
    """Products per delay, lag and block; the motors are averaged over the response's interval."""
    from scipy.signal import lfilter  # slow to import

    is_finite = np.asarray(np.isfinite(motors).all(axis=1))
    centred = np.where(is_finite[:, None], motors - motors[is_finite].mean(axis=0), 0.0)
    n, k = centred.shape
    usable, blocks = np.flatnonzero(is_finite & np.isfinite(response)), {}
    for delay in sorted({round(d / dt) for d in DELAYS_S} | {1}):
        rows_of = np.array_split(usable[usable >= delay], BLOCKS)
        blocks[delay] = [(rows, _centred(response[rows])) for rows in rows_of]
    products: list[tuple[FloatArray, ...]] = []
    for lag in LAGS_S:
        keep = float(np.exp(-dt / lag)) if lag else 0.0
        filtered = lfilter([1.0 - keep], [1.0, -keep], centred, axis=0)
        total = np.concatenate([np.zeros((1, k)), np.cumsum(filtered, axis=0)])
        mean = (total[step:] - total[:-step]) / step
        for delay, parts in blocks.items():
            delayed = np.zeros((n, k))
            delayed[delay : delay + len(mean)] = mean[: n - delay]
            centred_parts = [(_centred(delayed.take(rows, axis=0)), y) for rows, y in parts]
            sums = [(x.T @ x, x.T @ y, float(y @ y)) for x, y in centred_parts]
            products.append(tuple(map(np.array, zip(*sums, strict=True))))
    return _Response(name, *(np.array(part) for part in zip(*products, strict=True)))


def _centred(x: FloatArray) -> FloatArray:
    """A block (n, …) about its own mean."""
    return np.asarray(x - x.sum(axis=0) / max(len(x), 1))
