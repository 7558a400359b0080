"""A MATLAB file (.mat, up to version 7) → columns, by scipy: vectors and matrices of one length.

A structure's fields are named `structure.field`. Version 7.3 is HDF5, which is another format.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library
from quad_sysid.imports.rosbag import MAX_NUMBERS

LEAST = 20
"""Least length of a vector that is a recording."""


def read_mat(path: Path) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Columns, and what was left out. Raises BadInputError."""
    with read_by_library(path, 'cannot be read as a MATLAB file', 'save it again with -v7'):
        from scipy.io import loadmat

        content = loadmat(str(path), squeeze_me=True, struct_as_record=False)
    vectors: dict[str, FloatArray] = {}
    for name, value in content.items():
        if not name.startswith('__'):
            vectors |= dict(_vectors(name, value))
    sizes = Counter(len(values) for values in vectors.values() if len(values) >= LEAST)
    if not sizes:
        raise BadInputError(str(path), 'holds no vectors of numbers', ', '.join(
            name for name in content if not name.startswith('__')) or 'nothing',
            'save the columns as vectors of one length')
    length, _ = max(sizes.items(), key=lambda item: (item[1], item[0]))
    columns = {name: values for name, values in vectors.items() if len(values) == length}
    shorter = [name for name, values in vectors.items()
               if LEAST <= len(values) != length]
    notes = (f'{len(shorter)} vectors of another length than {length} left out: '
             + ', '.join(shorter[:5]),) if shorter else ()
    return columns, notes


def _vectors(name: str, value: Any) -> Iterator[tuple[str, FloatArray]]:
    if hasattr(value, '_fieldnames'):
        for key in vars(value)['_fieldnames']:
            yield from _vectors(f'{name}.{key}', getattr(value, key))
        return
    if not isinstance(value, np.ndarray):
        return
    if value.dtype == object:
        for i, cell in enumerate(value.ravel()[:MAX_NUMBERS]):
            yield from _vectors(f'{name}[{i}]', cell)
        return
    if value.dtype.kind not in 'biuf':
        return
    array = np.asarray(value, dtype=np.float64)
    array[~np.isfinite(array)] = np.nan
    if array.ndim == 1 and len(array) >= LEAST:
        yield name, array
    elif array.ndim > 1 and max(array.shape) >= LEAST:
        long = int(np.argmax(array.shape))
        flat = np.moveaxis(array, long, 0).reshape(array.shape[long], -1)
        if flat.shape[1] <= MAX_NUMBERS:
            yield from ((f'{name}[{i}]', flat[:, i].copy()) for i in range(flat.shape[1]))
