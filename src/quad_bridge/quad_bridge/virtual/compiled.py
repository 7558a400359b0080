"""How the numerical kernels of the virtual STM32 are compiled. No physics here.

Inner kernels (`kernel`) are compiled as part of the entry points that call them (`entry`). Only
entry points are cached on disk. Numba's cache sees changes of an entry's own file alone, so each
entry closes over a digest of every kernel source, which makes the cache follow all of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

from numba import njit

_F = TypeVar('_F', bound=Callable[..., object])

KERNEL_FILES = (
    'airframe.py',
    'compiled.py',
    'cycle.py',
    'physics.py',
    'plant.py',
    'rotation.py',
    'sensors.py',
)


def kernel(function: _F) -> _F:
    """Compile `function`, uncached: it is inlined into the entry points that call it."""
    return cast('_F', njit(error_model='numpy')(function))


def entry(function: _F) -> _F:
    """Compile `function` with an on-disk cache; it must close over `source_digest()`'s value."""
    return cast('_F', njit(cache=True, error_model='numpy')(function))


def source_digest() -> str:
    """Digest of all kernel sources, for the closures of entry points."""
    digest = hashlib.sha256()
    for name in KERNEL_FILES:
        path = Path(__file__).with_name(name)
        if path.exists():
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
