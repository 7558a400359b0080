"""How the inner loops are compiled: for one set of types each, at the first call or all at once.

Numba compiles them for the machine at hand and keeps the result. No loop stands here.
"""

from __future__ import annotations

import importlib
import mmap
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.core import event

_F = TypeVar('_F', bound=Callable[..., object])

NUMBER, WHOLE, FLAG = types.float64, types.int64, types.boolean
LINE, TABLE, BLOCK, BLOCKS = (
    NUMBER[::1], NUMBER[:, ::1], NUMBER[:, :, ::1], NUMBER[:, :, :, ::1])
WHOLES, FLAGS = WHOLE[::1], FLAG[::1]
"""Arrays of one to four dimensions, contiguous and writable: callers pass no others."""

MODULES = ('model.recursion', 'model.laws', 'blackbox.filters', 'loop.kernels')
"""Where the kernels are."""
_kernels: list[tuple[Any, tuple[Any, ...]]] = []
"""Each with the types of its arguments."""
_announced = mmap.mmap(-1, 1)
"""Not zero once it was said; forked processes share it."""


def inner(function: _F) -> _F:
    """`function`, compiled as a part of the kernels that call it."""
    return cast('_F', numba.njit(nogil=True, error_model='numpy')(function))


def kernel(*arguments: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A function that Python calls with arguments of these types; it is kept once compiled."""
    def decorate(function: Callable[..., Any]) -> Any:
        chosen = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = chosen or _place()
        try:
            dispatcher = numba.njit(
                cache=True, nogil=True, error_model='numpy', **options)(function)
        finally:
            numba.config.CACHE_DIR = chosen
        _kernels.append((dispatcher, arguments))
        return dispatcher

    return decorate


def _place() -> str:
    """Folder of what was compiled; empty for the one beside the source, as in a checkout.

    An installed package's own folder goes with each reinstallation, so there it is the user's.
    """
    if not {'site-packages', 'dist-packages'} & set(Path(__file__).parts):
        return ''
    own = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')  # noqa: PTH111
    return str(Path(own) / 'quad_suite')


def compile_all() -> list[str]:
    """Compile every kernel that is not there yet; the folders in which they are kept."""
    for module in MODULES:
        importlib.import_module(f'quad_sysid.{module}')
    for dispatcher, arguments in _kernels if not numba.config.DISABLE_JIT else ():
        dispatcher.compile(arguments)
    return sorted({kernel.stats.cache_path for kernel, _ in _kernels if hasattr(kernel, 'stats')})


class _Notice(event.Listener):  # type: ignore[misc]
    """Says once on stderr that a kernel is being compiled, which otherwise looks like a hang."""

    def on_start(self, event: Any) -> None:
        function = event.data['dispatcher'].py_func
        if function.__module__.partition('.')[0] != 'quad_sysid' or _announced[0]:
            return
        _announced[0] = 1
        wiped = '\r\x1b[2K' if sys.stderr.isatty() else ''
        sys.stderr.write(f'{wiped}compiling for this machine, once, half a minute\n')
        sys.stderr.flush()

    def on_end(self, event: Any) -> None:
        """Nothing is to be done."""


event.register('numba:compile', _Notice())
