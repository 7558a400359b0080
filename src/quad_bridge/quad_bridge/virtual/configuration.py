"""YAML -> frozen dataclasses, strictly: an unknown or mistyped key is one clear error line.

Knows nothing of aircraft. Profiles may `extends` another one; mappings merge, values replace.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import yaml

from quad_bridge.virtual.errors import ConfigurationError

LARGEST = 1e9  # no number of a profile is larger: none would fit the simulation's floats or memory
_T = TypeVar('_T')


def read_yaml(path: Path, library: Path, above: tuple[Path, ...] = ()) -> dict[str, object]:
    """The mapping in the YAML file `path`, with what it `extends` merged under it.

    `extends` names a profile beside the file or in the folder `library`; `above` are the files
    that extend this one.
    """
    mapping = read_mapping(path)
    parent = mapping.pop('extends', None)
    if parent is None:
        return mapping
    parent_file = (path.parent / str(parent)).with_suffix('.yaml')
    base = parent_file if parent_file.is_file() else (library / str(parent)).with_suffix('.yaml')
    children = (*above, path.resolve())
    if base.resolve() in children:
        raise ConfigurationError(f'{path}: extends', 'profiles extend each other in a circle')
    if not base.is_file():
        raise ConfigurationError(f'{path}: extends', 'no such profile', repr(parent))
    return merged(read_yaml(base, library, children), mapping)


def read_mapping(path: Path) -> dict[str, object]:
    """The mapping in one YAML file, {} for an empty one; ConfigurationError names the file."""
    try:
        loaded = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigurationError(str(path), f'cannot be read ({error.strerror})') from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # no text, digits, brackets
        raise ConfigurationError(str(path), f'is not YAML ({error})') from error
    mapping = {} if loaded is None else loaded
    if not isinstance(mapping, dict):
        raise ConfigurationError(str(path), f'must be a mapping of keys, is {loaded!r}')
    return mapping


def merged(under: Mapping[str, object], over: Mapping[str, object]) -> dict[str, object]:
    """`under` with the keys of `over` put over it, mappings merged key by key."""
    result = dict(under)
    for key, value in over.items():
        old = result.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)  # noqa: PLW2901
        result[key] = value
    return result


def build(kind: type[_T], mapping: object, where: str) -> _T:
    """The dataclass `kind` from a mapping; `where` is the file and the path of keys so far."""
    if not isinstance(mapping, Mapping):
        raise ConfigurationError(where, f'must be a mapping of keys, is {mapping!r}')
    hints = typing.get_type_hints(kind)
    for key in mapping:
        if key not in hints:
            names = ', '.join(hints)
            raise ConfigurationError(f'{where}.{key}', f'unknown key; known are {names}')
    for key in _required(kind):
        if key not in mapping:
            raise ConfigurationError(f'{where}.{key}', 'is missing; give it beside the others')
    values = {key: _value(hints[key], value, f'{where}.{key}') for key, value in mapping.items()}
    try:
        return kind(**values)
    except ValueError as error:
        raise ConfigurationError(where, str(error)) from error


def _required(kind: type) -> list[str]:
    """Fields without a default."""
    missing = dataclasses.MISSING
    return [
        f.name
        for f in dataclasses.fields(kind)
        if f.default is missing and f.default_factory is missing
    ]


def _value(hint: object, value: object, where: str) -> object:
    """`value` as `hint` asks; a tuple of three numbers may be given as one number."""
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return build(hint, value, where)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Mapping:
        if not isinstance(value, Mapping):
            raise ConfigurationError(where, f'must be a mapping of keys, is {value!r:.80}')
        return {str(key): _value(arguments[1], v, f'{where}.{key}') for key, v in value.items()}
    if origin is tuple:
        if Ellipsis in arguments:
            items = value if isinstance(value, (list, tuple)) else [value]
            return tuple(_value(arguments[0], v, f'{where}[{i}]') for i, v in enumerate(items))
        items = value if isinstance(value, (list, tuple)) else [value] * len(arguments)
        if len(items) != len(arguments):
            raise ConfigurationError(where, f'needs {len(arguments)} values, has {len(items)}')
        return tuple(
            _value(a, v, f'{where}[{i}]')
            for i, (a, v) in enumerate(zip(arguments, items, strict=True))
        )
    if type(None) in arguments:
        inner = next(a for a in arguments if a is not type(None))
        return None if value is None else _value(inner, value, where)
    return _scalar(hint, value, where)


def _scalar(hint: object, value: object, where: str) -> object:
    """A bool, int, finite float or string, or the error that names the key."""
    if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST:
        if hint is float:
            return float(value)
        if hint is int and isinstance(value, int):
            return value
    if hint in (bool, str) and isinstance(value, hint):
        return value
    names = {float: 'a finite number', int: 'a whole number', bool: 'true or false', str: 'text'}
    expected = names.get(hint, str(hint))  # type: ignore[call-overload]
    raise ConfigurationError(where, f'needs {expected}, is {value!r:.80}')
