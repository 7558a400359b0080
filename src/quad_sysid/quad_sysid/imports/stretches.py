"""Segments for flights without an experiment: the usable stretches, and those that are held out.

A flight is judged in pieces of a second; each piece that is left out gets a reason. The rest is
cut into blocks for training and validation, so that both contain some of every part of the flight.
Array maths on a Record.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.record import Record, Segment, finite_runs, motors_at_limit

PIECE_S = 1.0
"""Length of a piece, s, which is used or not."""
MAX_LOST = 0.2
"""Largest share of a piece that is gap or ground, or has a motor at its limit."""
AIRBORNE = 0.4
"""Share of the usual throttle below which the aircraft does not fly."""
GROUND_S = 1.0
"""For so long at least it stands on the ground; a shorter time is a dive. As long before and after
it may touch the ground: it takes off, or it lands."""
STILL = 0.1
"""Share of the usual motion and command below which nothing is excited."""
USUAL = 0.75
"""Quantile over the pieces that counts as usual."""
NEARLY_ALL = 0.9
"""Usable share of a short record from which it keeps no segments."""
MIN_DURATION_S = 3.0
"""Shortest stretch, since windows begin a second after its start."""
BLOCK_S = 5.0
"""Length of the blocks, s, that train and validate in turn; those of an experiment have about this
length, and of a short one less, down to MIN_DURATION_S."""
ROLES = ('train', 'train', 'validation', 'train', 'validation')
"""Roles of consecutive blocks: 60 % train."""


def with_stretches(record: Record, axes: tuple[str, ...] = AXES) -> Record:
    """The record with its segments, for all of `axes` alike.

    With fewer than five blocks the first 60 % train, as in a bag without segments; a short record
    of which nearly all is usable keeps no segments.
    """
    size = max(1, round(PIECE_S / record.dt))
    edges = np.arange(0, max(size, record.n - size // 2), size)
    why = _short(_reasons(record, edges, size), max(1, round(MIN_DURATION_S / PIECE_S)))
    used = np.array([not reason for reason in why])
    seconds = float(used.sum()) * size * record.dt
    if not used.any() or (used.mean() >= NEARLY_ALL and seconds < len(ROLES) * BLOCK_S):
        return record
    segments = []
    for start, stop in finite_runs(used, (0, len(used))):
        segments += _blocks(start, stop, size, record.dt, used, seconds)
    for reason in sorted({r for r in why if r}):
        hit = np.array([r == reason for r in why])
        segments += [('idle', a, b, reason) for a, b in finite_runs(hit, (0, len(hit)))]
    length = record.n * record.dt
    return replace(record, segments=tuple(sorted((
        Segment(role, 'none', axis, 'none', a * size * record.dt,
                length if b == len(edges) else b * size * record.dt,
                {'because': reason} if reason else {})
        for role, a, b, reason in segments for axis in axes
    ), key=lambda s: (s.start_s, s.axis))))


def blocks(length_s: float) -> list[tuple[str, float, float]]:
    """Role, begin and end, s, of the parts of an experiment: blocks of about BLOCK_S in turn.

    A sweep passes each frequency once: the first and the last block train, so that what is held
    out lies between them. Of one that is too short for six blocks the first 60 % train.
    """
    count = max(round(length_s / BLOCK_S), len(ROLES) + 1)
    size = length_s / count
    if size < MIN_DURATION_S:
        border = 0.6 * length_s
        return [('train', 0.0, border), ('validation', border, length_s)]
    out: list[tuple[str, float, float]] = []
    for k in range(count):
        role = 'train' if k == count - 1 else ROLES[k % len(ROLES)]
        begin = out.pop()[1] if out and out[-1][0] == role else size * k
        out.append((role, begin, size * (k + 1)))
    return out


def summary(record: Record) -> str:
    """One line on the used and the left out time, s."""
    if not record.segments:
        return ''
    axis = record.segments[0].axis
    sums: dict[str, float] = {}
    for s in record.segments:
        if s.axis == axis:
            name = str(s.parameters.get('because', s.role))
            sums[name] = sums.get(name, 0.0) + s.end_s - s.start_s
    excluded = ', '.join(f'{name} {sums[name]:.0f} s' for name in sums
                         if name not in ('train', 'validation'))
    return (f'the log holds no experiment: {sums.get("train", 0.0):.0f} s train, '
            f'{sums.get("validation", 0.0):.0f} s are held out' +
            (f'; left out: {excluded}' if excluded else ''))


def airborne(throttle: FloatArray, dt: float) -> np.ndarray:
    """(n,) whether the aircraft flies free of the ground, by its throttle (n,), dt s apart."""
    low = np.asarray(throttle < AIRBORNE * float(np.nanquantile(throttle, USUAL)))
    out = np.ones(len(low), dtype=bool)
    margin = round(GROUND_S / dt)
    for start, stop in finite_runs(low, (0, len(low))):
        if stop - start >= margin:
            out[max(0, start - margin) : stop + margin] = False
    return out


def _reasons(record: Record, edges: np.ndarray, size: int) -> list[str]:
    """Why each piece is left out; an empty text where it is used."""
    pieces = [slice(a, a + size) for a in edges[:-1]] + [slice(edges[-1], record.n)]
    is_finite = np.asarray(np.isfinite(record.rates + record.control[:, :1]).all(axis=1))

    def spread(values: np.ndarray) -> np.ndarray:
        out = np.zeros((len(pieces), values.shape[1]))
        for i, piece in enumerate(pieces):
            finite = values[piece][is_finite[piece]]
            if len(finite) > 1:
                out[i] = finite.std(axis=0)
        return out

    rates_spread, driven = spread(record.rates), spread(record.control[:, 1:])
    flying = airborne(record.control[:, 0], record.dt)
    still = [
        (values <= STILL * np.quantile(values, USUAL, axis=0)).all(axis=1)
        for values in (rates_spread, driven)
    ]
    motors = record.motors
    out = []
    for i, piece in enumerate(pieces):
        lost_share = 1.0 - float(is_finite[piece].mean())
        stuck = 0.0 if motors is None else float(motors_at_limit(motors[piece]).any(axis=1).mean())
        out.append('gap' if lost_share > MAX_LOST else
                   'ground' if not flying[piece].mean() >= 1.0 - MAX_LOST else
                   'saturated' if stuck > MAX_LOST else
                   'still' if still[0][i] or still[1][i] else '')
    return out


def _short(why: list[str], least: int) -> list[str]:
    used = np.array([not reason for reason in why])
    out = list(why)
    for start, stop in finite_runs(used, (0, len(used))):
        if stop - start < least:
            out[start:stop] = ['short'] * (stop - start)
    return out


def _blocks(
    start: int, stop: int, size: int, dt: float, used: np.ndarray, seconds: float
) -> list[tuple[str, int, int, str]]:
    """Blocks of one stretch; neighbours of one role are one segment."""
    before = int(used[:start].sum())
    block = max(1, round(BLOCK_S / (size * dt)))
    is_long = seconds >= len(ROLES) * BLOCK_S
    border = 0.6 * float(used.sum())
    out: list[tuple[str, int, int, str]] = []
    for k in range(start, stop):
        place = before + k - start
        role = ROLES[place // block % len(ROLES)] if is_long else \
            'train' if place < border else 'validation'
        if out and out[-1][0] == role:
            out[-1] = (role, out[-1][1], k + 1, '')
        else:
            out.append((role, k, k + 1, ''))
    return out
