"""The parts of an experiment that train a model and that are held out → segments of its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import Record, Segment, finite_runs

WHERE = 'arrays'
Part: TypeAlias = (bool | float | slice | tuple[float, float] | npt.NDArray[np.bool_]
                   | Sequence[slice] | Sequence[bool])
"""A part of an experiment: a fraction, a slice or slices of samples, a mask (n,), (from, to) in s,
or True for the whole of it and False for nothing."""
Parts: TypeAlias = Part | Sequence[Part]
"""A part of each experiment: one for all, or a list with one for each."""


def part_of(parts: Any, k: int, count: int) -> Any:
    """The part of experiment k: its own of a list with one for each, else the one for all."""
    return parts[k] if isinstance(parts, list) and len(parts) == count else parts


def with_parts(record: Record, time_s: FloatArray, axes: Sequence[str], train: Any,
               validate: Any) -> Record:
    """The record with the requested segments, if any, for samples at time_s (n,), s."""
    if train is None and validate is None:
        return record
    train_mask = None if train is None else _mask('train', train, time_s, last=False)
    held_out = ~np.asarray(train_mask) if validate is None else _mask('validate', validate, time_s,
                                                                      last=True)
    masks = {'train': ~held_out if train_mask is None else train_mask, 'validation': held_out}
    both = masks['train'] & masks['validation']
    if both.any():
        raise BadInputError(WHERE, 'train and validate overlap', f'{both.sum()} samples',
                            'keep them apart')
    segments = [
        Segment(role, 'unknown', axis, 'unknown', float(time_s[a]),
                float(time_s[b - 1]) + record.dt)
        for role, mask in masks.items() for a, b in finite_runs(mask, (0, time_s.size))
        for axis in axes
    ]
    return replace(record, segments=tuple(sorted(segments, key=lambda s: s.start_s)))


def _mask(name: str, part: Any, time_s: FloatArray, *, last: bool) -> np.ndarray:
    """(n,) which samples a part holds; a fraction is the first samples, or the last."""
    n = time_s.size
    if isinstance(part, bool | np.bool_):
        return np.full(n, bool(part))
    if isinstance(part, float | int | np.number):
        if not 0.0 < part < 1.0:
            raise BadInputError(WHERE, f'{name} as a fraction must be between 0 and 1', part)
        count = round(float(part) * n)
        return np.arange(n) >= n - count if last else np.arange(n) < count
    if isinstance(part, slice):
        out = _sliced(name, [part], n)
    elif isinstance(part, list | tuple) and part and all(isinstance(p, slice) for p in part):
        out = _sliced(name, part, n)
    elif isinstance(part, tuple) and len(part) == 2:
        out = (time_s >= float(part[0])) & (time_s < float(part[1]))
    else:
        out = np.array(part)
        if out.dtype.kind != 'b':
            raise BadInputError(WHERE, f'{name} must be a fraction, a slice, a mask or (from, to)',
                                out.dtype)
        if out.shape != (n,):
            raise BadInputError(WHERE, f'{name} must be a mask as long as u',
                                f'{out.shape} and {n}')
    if not out.any():
        raise BadInputError(WHERE, f'{name} holds no sample', part)
    return out


def _sliced(name: str, pieces: Sequence[slice], n: int) -> np.ndarray:
    out = np.zeros(n, dtype=bool)
    for piece in pieces:
        if piece.step not in (None, 1):
            raise BadInputError(WHERE, f'{name} must take every sample of its slice', piece)
        out[piece] = True
    return out
