"""Training and validation segments where the bag states none, or the user chooses.

Pure: Record in, Record out. Source: contract, Topics (60 % / 40 %, `--train A:B --validate C:D`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.record import Record, Segment

Span = tuple[float, float]
"""Start and end, s from the record's first sample."""


def parse_span(text: str, option: str) -> Span:
    """Read `A:B` (s; without A or B: the record's start or end) of a command's option."""
    start, colon, end = text.partition(':')
    try:
        span = (float(start or 0.0), float(end or 'inf'))
    except ValueError:
        span = (np.nan, np.nan)
    if not colon or not 0.0 <= span[0] < span[1]:
        raise BadInputError(option, 'needs two times START:END in s, START before END', repr(text),
                            f'for example {option} 5:45')
    return span


def split_segments(record: Record, train: Span | None = None, validate: Span | None = None,
                   axes: tuple[str, ...] | None = None) -> Record:
    """The record with the segments for its analysis.

    `train` and `validate` (s) replace the bag's segments for each of `axes` (None: those that the
    bag excites, else all). With only one of them, the other role keeps the bag's segments or, if
    there are none, gets the rest of the record. Without both, and without segments in the bag, the
    first 60 % train and the rest validates. Raises BadInputError for spans that overlap or lie
    outside the record.
    """
    evaluated = [s for s in record.segments if s.role in ('train', 'validation')]
    if train is None and validate is None:
        if evaluated:
            return record
        train = (0.0, 0.6 * record.n * record.dt)
    if axes is None:
        axes = tuple(axis for axis in EVERY if axis in {s.axis for s in evaluated}) or AXES
    train, cut = clip_span(train, record, '--train')
    validate, more = clip_span(validate, record, '--validate')
    segments: list[Segment] = []
    for role, span, other in (('train', train, validate), ('validation', validate, train)):
        if span is None and evaluated:
            segments += [s for s in evaluated if s.role == role]
            continue
        chosen = span or _rest(other, record.n * record.dt, role)
        segments += [_segment(record, role, axis, chosen) for axis in axes]
    _check_overlap(segments, record)
    segments += [s for s in record.segments if s.role == 'idle' and evaluated]
    return replace(record, segments=tuple(sorted(segments, key=lambda s: s.start_s)),
                   warnings=(*record.warnings, *cut, *more))


def clip_span(
    span: Span | None, record: Record, option: str
) -> tuple[Span | None, tuple[str, ...]]:
    """The span, cut at the record's end, and a line where more than a sample was cut off.

    Raises BadInputError (naming the option) where it starts after the end.
    """
    if span is None:
        return None, ()
    length = record.n * record.dt
    if span[0] >= length:
        raise BadInputError(record.source, f'{option} starts after the end of the record',
                            f'{span[0]:g} s of {length:.2f} s')
    cut = f'{option} {span[0]:g}:{span[1]:g} is cut at the end of the record, {length:.2f} s'
    return (span[0], min(span[1], length)), (cut,) * (length + record.dt < span[1] < np.inf)


def _check_overlap(segments: list[Segment], record: Record) -> None:
    """Raise BadInputError where training and validation of an axis overlap."""
    for a in segments:
        for b in segments:
            shared = min(a.end_s, b.end_s) - max(a.start_s, b.start_s)
            if (a.role, b.role, a.axis) == ('train', 'validation', b.axis) and shared > 1e-9:
                raise BadInputError(record.source, f'{a.axis}: training and validation overlap',
                                    f'{a.start_s:g}:{a.end_s:g} s and {b.start_s:g}:{b.end_s:g} s',
                                    'give both --train and --validate, apart from each other')


def _rest(other: Span | None, length: float, role: str) -> Span:
    """The rest of the record: after `other` for validation, before it for training."""
    start, end = other or (0.0, length)
    before, after = (0.0, start), (end, length)
    first, second = (before, after) if role == 'train' else (after, before)
    if first[1] - first[0] > 0.0:
        return first
    if second[1] - second[0] > 0.0:
        return second
    raise BadInputError(f'--{"train" if role == "validation" else "validate"}',
                        f'leaves nothing to {role}', f'{start:g}:{end:g} of {length:g} s',
                        'choose a shorter span')


def _segment(record: Record, role: str, axis: str, span: Span) -> Segment:
    """One segment, with signal and injection of the bag's segment in which it lies, if any."""
    middle = 0.5 * (span[0] + span[1])
    for segment in record.segments:
        if segment.start_s <= middle < segment.end_s and segment.axis == axis \
                and segment.role != 'idle':
            return replace(segment, role=role, start_s=span[0], end_s=span[1])
    return Segment(role, 'unknown', axis, 'unknown', *span)
