"""An effect's law as a list of operations on numbers, taken down while the law itself runs.

A Traced stands where a law expects an array: numpy's functions then note what they would compute.
The list is run by compiled code (loop/kernels.py), so that a law is written once and is as fast as
a compiled one. What cannot be noted, such as a branch on a value, raises Untraceable; such a law
is called in its place in the list.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray

Indices = NDArray[np.int64]

OPERATIONS = (
    'add', 'subtract', 'multiply', 'divide', 'maximum', 'minimum', 'power', 'greater',
    'greater_equal', 'less', 'less_equal', 'negative', 'absolute', 'sign', 'exp', 'log', 'sqrt',
    'sin', 'cos', 'tanh', 'floor', 'rint', 'where', 'interp', 'loose', 'yielded', 'called',
)
"""What the compiled code can do, by numpy's names; of the last five, numbers stand in `more`."""
CODES = {name: code for code, name in enumerate(OPERATIONS)}
SEVERAL = {CODES[name] for name in ('where', 'interp', 'loose', 'yielded', 'called')}
"""Whose operands stand in `more`."""


class Untraceable(Exception):  # noqa: N818 - no fault of anyone's
    """A law does what cannot be noted."""


class Listing:
    """The operations so far; each number has a register, and constants have theirs.

    cycles: the length of arrays along a flight, which have a register for the number of a cycle.
    """

    def __init__(self, cycles: int = 0) -> None:
        self.cycles = cycles
        self._along: dict[int, tuple[Any, Indices]] = {}
        self.code: list[tuple[int, int, int, int]] = []
        """Operation, where its first result goes, and two operands or a place in `more`."""
        self.results: list[int] = []
        """Number of results of each."""
        self.more: list[int] = []
        self.start: list[float] = []
        """The start of every register: constants, and 0 where an input or a result goes."""
        self.tables: list[float] = []
        self.calls: list[Call] = []
        """The laws of the operation `called`, whose last operand is a place here."""
        self._known: dict[tuple[Any, ...], int] = {}
        self._constants: dict[float, int] = {}
        self._fixed: set[int] = set()
        self._tables: dict[tuple[float, ...], int] = {}

    def place(self, value: float = 0.0) -> int:
        """A new register."""
        self.start.append(float(value))
        return len(self.start) - 1

    def constant(self, value: float) -> int:
        """The register of a constant."""
        value = float(value)
        if value not in self._constants:
            self._constants[value] = self.place(value)
            self._fixed.add(self._constants[value])
        return self._constants[value]

    def inputs(self, *shape: int) -> Traced:
        """Registers that are filled before a run."""
        places = [self.place() for _ in range(int(np.prod(shape)))]
        return Traced(self, np.array(places, dtype=np.int64).reshape(shape))

    def note(self, name: str, operands: Sequence[int], numbers: Sequence[float] = (),
             results: int = 1) -> int:
        """The register of the first result of an operation, which is noted once."""
        if name not in CODES:
            raise Untraceable(name)
        places = (*operands, *(self.constant(x) for x in numbers))
        if results == 1 and self._fixed.issuperset(places) and hasattr(np, name) \
                and name not in ('interp', 'where'):
            return self.constant(float(getattr(np, name)(*(self.start[i] for i in places))))
        key = (name, *places)
        if key not in self._known:
            first = self.place()
            for _ in range(results - 1):
                self.place()
            if CODES[name] in SEVERAL:
                a, b = len(self.more), len(places)
                self.more.extend(places)
            else:
                a, b = (*places, 0)[:2]
            self.code.append((CODES[name], first, a, b))
            self.results.append(results)
            self._known[key] = first
        return self._known[key]

    def call(self, made: Made, passed: Any, like: Sequence[FloatArray]) -> list[Traced]:
        """The results, of the shapes of `like`, of a law that is called.

        given: what it takes, a tree of tuples and mappings with Traced at its ends.
        """
        operands: list[int] = []
        with_ends(passed, lambda leaf: operands.extend(leaf.at.ravel().tolist()))
        stops = np.cumsum([array.size for array in like])
        first = self.note('called', operands, (len(self.calls),), int(stops[-1]))
        places = np.split(np.arange(first, first + stops[-1]), stops[:-1])
        self.calls.append(Call(made, passed, places))
        return [Traced(self, indices.reshape(array.shape))
                for indices, array in zip(places, like, strict=True)]

    def called(self, code: Indices) -> list[tuple[int, Call]]:
        """The operations of `code` (m, 4) that are laws in Python: index and call."""
        return [(k, self.calls[int(self.start[self.more[a + b - 1]])])
                for k, (what, _, a, b) in enumerate(code) if what == CODES['called']]

    def table(self, numbers: tuple[float, ...]) -> int:
        """Index of the first of these numbers in `tables`."""
        if numbers not in self._tables:
            self._tables[numbers] = len(self.tables)
            self.tables.extend(numbers)
        return self._tables[numbers]

    def needed(self, results: Sequence[int], split: int) -> tuple[NDArray[np.int64], int]:
        """The operations (m, 4) that these results need, and how many are of the first `split`."""
        registers, listing = set(results), []
        for i in reversed(range(len(self.code))):
            code, first, a, b = self.code[i]
            if not registers.isdisjoint(range(first, first + self.results[i])):
                listing.append(i)
                several = code in SEVERAL
                registers.update(self.more[a : a + b] if several else (a, b))
        rows = [self.code[i] for i in reversed(listing)]
        return (np.array(rows, dtype=np.int64).reshape(-1, 4),
                sum(i < split for i in listing))

    def repeated(self, following: Indices) -> tuple[Indices, FloatArray, Indices]:
        """The operations (m, 4) from a state to that of a cycle later, along arrays.

        With the rows (r, cycles) that they read, and the registers (r,) of these.
        """
        code, _ = self.needed(following.tolist(), 0)
        read = {*following.tolist()}
        for what, _, a, b in code.tolist():
            read.update(self.more[a : a + b] if what in SEVERAL else (a, b))
        used = [(row, place) for value, places in self._along.values()
                for row, place in zip(value.reshape(-1, self.cycles), places.ravel(), strict=True)
                if place in read]
        inputs = np.array([row for row, _ in used], float).reshape(len(used), self.cycles)
        return code, inputs, np.array([place for _, place in used], dtype=np.int64)

    def numbers(self, w: int) -> tuple[Indices, FloatArray]:
        """`more`, and `tables` (t, w) of w runs side by side, as compiled code takes them."""
        return np.array([*self.more, 0]), np.repeat([[*self.tables, 0.0]], w, axis=0).T.copy()

    def places(self, value: Any) -> Indices:
        """The registers of an array, a number or what is Traced."""
        if isinstance(value, Traced):
            return value.at
        if isinstance(value, float):
            return np.array(self.constant(value))
        if value is None:
            raise Untraceable('a signal that is not there')
        if id(value) in self._along:
            return self._along[id(value)][1]
        array = np.asarray(value, dtype=np.float64)
        if self.cycles and array.shape[-1:] == (self.cycles,):
            shape = *array.shape[:-1], 1
            places = np.array([self.place() for _ in range(math.prod(shape))]).reshape(shape)
            self._along[id(value)] = value, places
            return places
        return np.array([self.constant(x) for x in array.ravel()],
                        dtype=np.int64).reshape(array.shape)

    def apart(self, value: Any) -> list[int]:
        """The registers of a value, flattened; known numbers get registers that nothing else uses.

        Which register is which then does not depend on their values.
        """
        if isinstance(value, Traced):
            return [int(i) for i in value.at.ravel()]
        return [self.place(x) for x in np.ravel(value)]

    def each(self, name: str, *values: Any, numbers: Sequence[float] = ()) -> Traced:
        """An operation on every element."""
        places = [self.places(value) for value in values]
        if all(place.size == 1 for place in places):  # most often, and much quicker
            indices = np.array(self.note(name, [place.item() for place in places], numbers))
            return Traced(self, indices.reshape(max((place.shape for place in places), key=len)))
        arrays = np.broadcast_arrays(*places)
        out = np.array([self.note(name, operands, numbers) for operands
                        in zip(*(array.ravel().tolist() for array in arrays), strict=True)],
                       dtype=np.int64)
        return Traced(self, out.reshape(arrays[0].shape))


class Traced(np.lib.mixins.NDArrayOperatorsMixin):
    """An array of registers, in place of numbers that are computed later."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, listing: Listing, at: Indices) -> None:
        self.listing, self.at = listing, at

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape, as of an array."""
        return self.at.shape

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.at.size

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return self.at.ndim

    @property
    def T(self) -> Traced:  # noqa: N802 - numpy's name
        """Transposed."""
        return Traced(self.listing, self.at.T)

    def __len__(self) -> int:
        return len(self.at)

    def __iter__(self) -> Iterator[Traced]:
        return (self[i] for i in range(len(self.at)))

    def __getitem__(self, index: Any) -> Traced:
        return Traced(self.listing, np.asarray(self.at[index]))

    def __setitem__(self, index: Any, value: Any) -> None:
        self.at = self.at.copy()
        self.at[index] = self.listing.places(value)

    def sum(self, axis: int | None = None) -> Traced:
        """Sum over an axis, as by `ndarray.sum`."""
        return _sum(self, axis)

    def __getattr__(self, name: str) -> Any:
        """A method of an array that moves its numbers only; any other, such as `clip`, raises."""
        if name in ('reshape', 'ravel', 'copy'):
            return lambda *shape: Traced(self.listing, getattr(self.at, name)(*shape))
        raise (AttributeError if name.startswith('__') else Untraceable)(name)

    def __bool__(self) -> bool:
        raise Untraceable('a branch on a value')

    def __float__(self) -> float:
        raise Untraceable('a value as one number')

    def __array__(self, *_: Any, **__: Any) -> FloatArray:
        raise Untraceable('a value as a plain array')

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **more: Any) -> Any:
        """Record the operation, which numpy calls instead of computing it."""
        if more:
            raise Untraceable(f'{ufunc.__name__} with {", ".join(more)}')
        if method == 'outer':
            left, other = (self.listing.places(x) for x in inputs)
            inputs = (Traced(self.listing, left.reshape(left.shape + (1,) * other.ndim)),
                      Traced(self.listing, other))
        elif method != '__call__':
            raise Untraceable(f'{ufunc.__name__}.{method}')
        if ufunc is np.matmul:
            return _contracted(*inputs)
        if ufunc is np.square or (
                ufunc is np.power and np.ndim(inputs[1]) == 0 and inputs[1] == 2):
            return self.listing.each('multiply', inputs[0], inputs[0])
        return self.listing.each(ufunc.__name__, *inputs)

    def __array_function__(self, function: Callable[..., Any], _: Any, arguments: tuple[Any, ...],
                           more: dict[str, Any]) -> Any:
        """Record a numpy function that is no ufunc."""
        if function not in FUNCTIONS:
            raise Untraceable(function.__name__)
        return FUNCTIONS[function](*arguments, **more)


Made = Callable[[Any], Callable[[], Sequence[FloatArray]]]
"""A law of what it takes: called again and again, it gives results of what stands there then."""


class Call(NamedTuple):
    """A law in Python among the operations."""

    made: Made
    passed: Any
    results: Sequence[Indices]
    """The registers of each."""

    def on(self, r: FloatArray) -> Callable[[], None]:
        """The call on these registers, which the law sees as arrays that are not copied."""
        gathered: list[tuple[FloatArray, Indices]] = []

        def view(number: Traced) -> FloatArray:
            places = number.at.ravel()
            if (np.diff(places) == 1).all():
                return r[places[0] : places[-1] + 1].reshape(number.shape)
            gathered.append((np.empty(places.size), places))
            return gathered[-1][0].reshape(number.shape)

        law = self.made(with_ends(self.passed, view))
        places = [r[result[0] : result[-1] + 1] for result in self.results]

        def call() -> None:
            for values, indices in gathered:
                values[:] = r[indices]
            for place, result in zip(places, law(), strict=True):
                place[:] = result.ravel()

        return call


def with_ends(tree: Any, by: Callable[[Traced], Any]) -> Any:
    """A tree of tuples and mappings with something else where it ends in what is Traced."""
    if isinstance(tree, Mapping):
        return {name: with_ends(item, by) for name, item in tree.items()}
    if isinstance(tree, tuple):
        return tuple(with_ends(item, by) for item in tree)
    return by(tree) if isinstance(tree, Traced) else tree


def _listing(*values: Any) -> Listing:
    return next(x.listing for x in values if isinstance(x, Traced))


def _joined(join: Callable[..., Any]) -> Callable[..., Traced]:
    def joined(parts: Sequence[Any], axis: int = 0) -> Traced:
        listing = _listing(*parts)
        return Traced(listing, join([listing.places(x) for x in parts], axis=axis))

    return joined


def _moved(function: Callable[..., Any]) -> Callable[..., Traced]:
    """A function that only moves elements."""
    def moved(x: Traced, *arguments: Any, **more: Any) -> Traced:
        return Traced(x.listing, np.array(function(x.at, *arguments, **more)))

    return moved


def _sum(x: Traced, axis: int | None = None) -> Traced:
    rows = x.at.ravel() if axis is None else np.moveaxis(x.at, axis, 0)
    total = Traced(x.listing, np.asarray(rows[0]))
    for row in rows[1:]:
        total = total + Traced(x.listing, np.asarray(row))
    return total


def _contracted(a: Any, x: Any, axes: int = 1) -> Traced:
    """The sum over the last axis of one and the first of the other."""
    listing = _listing(a, x)
    left, other = listing.places(a), listing.places(x)
    if axes != 1 or left.shape[-1] != other.shape[0]:
        raise Untraceable('tensordot')
    return _sum(Traced(listing, np.moveaxis(left, -1, 0).reshape(
        (left.shape[-1], *left.shape[:-1], *[1] * (other.ndim - 1)))) * Traced(
            listing, other.reshape((len(other), *[1] * (left.ndim - 1), *other.shape[1:]))), 0)


def _interp(x: Traced, knots: Any, values: Any) -> Traced:
    table = x.listing.table((*map(float, knots), *map(float, values)))
    return x.listing.each('interp', x, numbers=(table, len(knots)))


FUNCTIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    np.where: lambda c, a, b: _listing(c, a, b).each('where', c, a, b),
    np.clip: lambda x, low, high: np.minimum(np.maximum(
        x, -np.inf if low is None else low), np.inf if high is None else high),
    np.stack: _joined(np.stack), np.concatenate: _joined(np.concatenate),
    np.sum: _sum, np.tensordot: _contracted, np.interp: _interp,
    np.round: lambda x: x.listing.each('rint', x),
    np.zeros_like: lambda x: np.zeros(x.shape), np.ones_like: lambda x: np.ones(x.shape),
    np.full_like: lambda x, value: np.full(x.shape, value),
    np.shape: lambda x: x.shape, np.ndim: lambda x: x.ndim,
    np.repeat: _moved(np.repeat), np.broadcast_to: _moved(np.broadcast_to),
    np.moveaxis: _moved(np.moveaxis),
}


def operation_of(name: str, operands: Sequence[Any], numbers: Sequence[float],
                 results: int) -> Any:
    """An operation that compiled code has and numpy lacks: `results` arrays like the operands."""
    listing = _listing(*operands)
    arrays = np.broadcast_arrays(*(listing.places(value) for value in operands))
    first = np.array([listing.note(name, places, numbers, results) for places
                      in zip(*(array.ravel().tolist() for array in arrays), strict=True)],
                     dtype=np.int64).reshape(arrays[0].shape)
    return [Traced(listing, first + i) for i in range(results)]
