"""model.json: identified models on disk and back, strictly checked: grey boxes and black boxes.

Schema quad_sysid/model/3. Its fields are those of the dataclasses in quad_sysid.model, by the
types that they declare. NaN is not JSON: a covariance row held at a bound and a standard error
that does not exist are stored as null. Nothing is fitted or judged here.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from quad_sysid.axes import axes_in, axis_of
from quad_sysid.blackbox import Model, polynomial_model
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.files import read_json, write_whole
from quad_sysid.model import LAW, AxisModel
from quad_sysid.model.effect import Effect

SCHEMA = 'quad_sysid/model/3'
BEFORE = 'quad_sysid/model/2'
"""Had no explanation; read as one that has none."""
RENAMED = {
    'lead': ('mode:lead', ''), 'second lag': ('mode:second_lag', ''),
    'second order': ('mode:second_order', ''), 'slow state': ('mode:slow_state', ''),
    'swinging': ('mode:swinging', ''), 'hysteresis': ('mode:hysteresis', ''),
    'loose, leaning': ('mode:loose_load', 'leaning'),
    'loose, turning': ('mode:loose_load', 'turning'), 'loose, driven': ('mode:soft_mount', ''),
    'yielding, turning': ('mode:yielding', 'turning'),
    'yielding, leaning': ('mode:yielding', 'leaning'),
    'yielding, driven': ('mode:yielding', 'driven'), 'response to drive': ('mode:response', ''),
}
"""Variants of what was one effect `mode` before each had a name: name and variant now."""
FILE = 'model.json'
"""Its name in the folder of a report."""
BASE_NAMES = ('gain', 'lag', 'delay', 'damping', 'bias')
POLYNOMIALS = ('A', 'B', 'C', 'D', 'F')
NOT_STORED = {'axis', 'own_effects'}
"""Fields that follow from the file's form or come from the caller."""
OPTIONAL = {'craft', 'units', 'interval', 'mean_throttle', 'ranges', 'rungs', 'reference',
            'explains_pct', 'held_out', 'no_gains_because'}
"""Fields that older files lack; their defaults are what was meant."""
BLACKBOX = ('structure', 'orders', 'approach', *POLYNOMIALS, 'nk', 'dt', 'noise_variance',
            'covariance')
"""Fields of a polynomial model that are stored."""
REMEDY = 'give the model.json of quad-sysid identify, or its folder'
AGAIN = 'identify again with this version'


def save_models(models: Mapping[str, AxisModel], path: str | os.PathLike[str],
                blackbox: Mapping[str, Mapping[str, Any]] | None = None) -> None:
    """Write the models of a flight, by axis, to `path`, atomically.

    `blackbox`: trees of the selected black-box models by axis. Raises BadInputError where a
    number that must be finite is not, or the file cannot be written.
    """
    tree = tree_of_models(models, blackbox, str(path))
    write_whole(path, json.dumps(tree, indent=1, allow_nan=False) + '\n')


def tree_of_models(models: Mapping[str, AxisModel],
                   blackbox: Mapping[str, Mapping[str, Any]] | None = None,
                   where: str = 'model') -> dict[str, Any]:
    """The models as plain values; BadInputError, naming `where`, for what must be finite."""
    axes = {a: _stored(AxisModel, model, f'{where}: {a}') for a, model in models.items()}
    return {'schema': SCHEMA, 'axes': axes, **({'blackbox': blackbox} if blackbox else {})}


def names_model(path: str | os.PathLike[str]) -> bool:
    """Whether a path is that of a model: a JSON file, or the folder of a report with one."""
    folder = Path(path)
    there = (folder / FILE).is_file() and not (folder / 'metadata.yaml').exists()  # of a bag
    return folder.suffix == '.json' or there


def located(path: str | os.PathLike[str]) -> Path:
    """The model.json of a path, which may be the folder that `identify` wrote it into."""
    place = Path(path)
    if not place.is_dir():
        return place
    if not (place / FILE).exists():
        raise BadInputError(str(place), f'is a folder without a {FILE}', remedy=REMEDY)
    return place / FILE


def load_models(path: str | os.PathLike[str],
                own_effects: Sequence[Effect] = ()) -> dict[str, AxisModel]:
    """Models by axis from a model.json or its folder; raises BadInputError naming the field.

    `own_effects`: the caller's effects that the models may name too.
    """
    path = located(path)
    return models_of(read_json(path, REMEDY), str(path), own_effects)


def models_of(tree: object, path: str, own_effects: Sequence[Effect] = ()) -> dict[str, AxisModel]:
    """Models by axis from plain values; messages name the `path`."""
    root = _keys(tree, path, {'schema', 'axes'}, more=True)
    if root['schema'] not in (SCHEMA, BEFORE):
        raise BadInputError(f'{path}: schema', f'must be {SCHEMA}', root['schema'], REMEDY)
    axes = root['axes']
    if not isinstance(axes, dict) or not axes:
        raise BadInputError(f'{path}: axes', 'must be an object with at least one axis', axes,
                            REMEDY)
    for axis in axes:
        axis_of(f'{path}: axes', axis)
    effects = tuple(own_effects)
    models = {axis: _with_own(_renamed(_model(axis, tree, f'{path}: axes.{axis}', effects)),
                              effects) for axis, tree in axes.items()}
    for axis, model in models.items():
        for one in filter(None, (model, model.reference)):
            _refuse_unrunnable(one, f'{path}: axes.{axis}')
    return models


def _with_own(model: AxisModel, effects: Sequence[Effect]) -> AxisModel:
    """A model with the caller's effects, for arrays in the units that it was identified from."""
    return replace(model, own_effects=tuple(effect.in_units(model.units) for effect in effects),
                   reference=model.reference and _with_own(model.reference, effects))


def pick(models: Mapping[str, AxisModel], axes: str | None,
         path: str | os.PathLike[str]) -> dict[str, AxisModel]:
    """The models of the axes that --axis names, of all without it; `all` takes what is there.

    BadInputError naming the file where it lacks one that is named, holds none of `all`, or names
    an effect that is not known here.
    """
    requested, named = (axes_in(axes), axes.split(',')) if axes is not None else (models, ())
    chosen = {axis: models[axis] for axis in requested if axis in models}
    absent = [axis for axis in requested if axis not in models and (axis in named or not chosen)]
    if absent:
        raise BadInputError(f'{path}: axes', f'lacks {", ".join(absent)}',
                            remedy=f'it holds {", ".join(models)}')
    return runnable(chosen, path)


def runnable(models: Mapping[str, AxisModel],
             path: str | os.PathLike[str]) -> dict[str, AxisModel]:
    """The models of a file; BadInputError naming it where an effect is not known here."""
    from quad_sysid.estimate.stored import completed

    try:
        for one in (m for model in models.values() for m in (model, model.reference) if m):
            completed(one)
    except BadInputError as error:
        raise BadInputError(str(path), str(error)) from error
    return dict(models)


def tree_of(model: Model) -> dict[str, Any]:
    """A polynomial model as plain values; B with its leading zeros, covariance null if unknown."""
    if model.covariance is not None and not np.isfinite(model.covariance).all():
        model = replace(model, covariance=None)
    hints = get_type_hints(Model)
    return {**{n: _stored(hints[n], getattr(model, n), f'{model.name}.{n}') for n in BLACKBOX},
            'parameter_names': list(model.parameter_names)}


def load_blackbox(path: str | os.PathLike[str]) -> dict[str, Model]:
    """The black-box models of a model.json by axis; empty where it holds none.

    Raises BadInputError naming file and field where they cannot be read.
    """
    path = located(path)
    tree = read_json(path)
    axes = tree.get('blackbox', {}) if isinstance(tree, dict) else {}
    if not isinstance(axes, dict):
        raise BadInputError(f'{path}: blackbox', 'must be an object', type(axes).__name__)
    return {axis: _polynomial(tree, f'{path}: blackbox.{axis}') for axis, tree in axes.items()}


def _model(axis: str, tree: object, where: str, own_effects: Sequence[Effect]) -> AxisModel:
    field_names = {f.name for f in fields(AxisModel)} - NOT_STORED
    content = dict(_keys(tree, where, field_names))
    reference = content.pop('reference', None)
    model = AxisModel(axis=axis, **_read_fields(AxisModel, content, where), reference=None
                      if reference is None else
                      _model(axis, reference, f'{where}.reference', own_effects))
    named = [p.name for p in model.base]
    law = {name.rpartition('.')[0] for name in named} - {''}
    if not law <= {effect.name for effect in own_effects if effect.kind == LAW}:
        raise BadInputError(f'{where}.base', "is a base of one's own, whose law is not here",
                            ', '.join(law), 'hand it in: effects=(base.law(),)')
    if sorted(name for name in named if '.' not in name) != sorted(BASE_NAMES):
        raise BadInputError(f'{where}.base', f'must list {", ".join(BASE_NAMES)}',
                            ', '.join(named))
    if model.dt <= 0:
        raise BadInputError(f'{where}.dt', 'must be a positive number of seconds', model.dt)
    p = len(model.parameter_names)
    if model.covariance is not None and model.covariance.shape != (p, p):
        raise BadInputError(f'{where}.covariance', f'must be {p} by {p}, as parameter_names say')
    _refuse_negative(model, where)
    for name, noise in (('noise', model.noise), ('plain_noise', model.plain_noise)):
        numbers = {} if noise is None else {**noise.ratios, **vars(noise)}
        for key, value in numbers.items():
            if isinstance(value, float) and not value > 0.0:
                raise BadInputError(f'{where}.{name}.{key}', 'must be positive', value)
    return model


def _renamed(model: AxisModel) -> AxisModel:
    """The model with the names that its effects have now."""
    if not any(effect.name == 'mode' for effect in model.effects):
        return model
    effects = []
    for effect in model.effects:
        name, variant = RENAMED.get(effect.variant, ('mode', effect.variant)) \
            if effect.name == 'mode' else (effect.name, effect.variant)
        effects.append(replace(effect, name=name, variant=variant))
    names = (*(parameter.name for parameter in model.base),
             *(f'{effect.name}.{item.name}' for effect in effects for item in effect.parameters))
    return replace(model, effects=tuple(effects), parameter_names=names
                   if len(names) == len(model.parameter_names) else model.parameter_names)


def _refuse_negative(model: AxisModel, where: str) -> None:
    """Raise BadInputError for a lag, delay or variance that no plant can have."""
    values = {f'base.{name}.value': model.value(name) for name in ('lag', 'delay')}
    if model.covariance is not None:
        names = (f'covariance.{name}' for name in model.parameter_names)
        values |= dict(zip(names, map(float, np.diag(model.covariance)), strict=True))
    for name, value in values.items():
        if value < 0.0:  # NaN: a variance at a bound
            raise BadInputError(f'{where}.{name}', 'must not be negative', value, AGAIN)


def _refuse_unrunnable(model: AxisModel, where: str) -> None:
    """Raise BadInputError where its effects, if they are known here, do not run as stored."""
    from quad_sysid.loop.from_model import whole_plant  # seconds to import, with scipy's

    try:
        with np.errstate(all='ignore'):
            if np.isfinite(whole_plant(model).rest_acceleration):
                return
    except QuadSysidError:  # whoever runs it may hand in what is not known
        return
    except (ArithmeticError, LookupError, TypeError, ValueError):
        pass
    names = ' or '.join(effect.name for effect in model.effects)
    raise BadInputError(f'{where}.effects', 'holds settings with which an effect cannot run',
                        names, AGAIN)


def _polynomial(tree: object, where: str) -> Model:
    content = _keys(tree, where, set(BLACKBOX), more=True)
    read = _read_fields(Model, {name: content[name] for name in BLACKBOX}, where)
    try:
        checked = polynomial_model(
            **{name: read[name] for name in (*POLYNOMIALS, 'dt', 'nk', 'noise_variance')}
        )
    except BadInputError as error:
        raise BadInputError(where, str(error)) from error
    model = replace(checked, **{name: read[name] for name in BLACKBOX})
    p = model.parameters.size
    if model.covariance is not None and model.covariance.shape != (p, p):
        raise BadInputError(f'{where}.covariance', f'must be {p} by {p}', model.covariance.shape)
    return model


def _stored(kind: Any, value: Any, where: str) -> Any:
    """`value` as JSON by its declared type; only where that may be None is NaN null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if is_dataclass(value):
        hints = get_type_hints(type(value))
        return {f.name: _stored(hints[f.name], getattr(value, f.name), f'{where}.{f.name}')
                for f in fields(value) if f.name not in NOT_STORED}
    kinds = [k for k in get_args(kind) if k is not Ellipsis] or [object]
    if isinstance(value, Mapping):
        return {str(key): _stored(kinds[-1], item, f'{where}.{key}')
                for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_stored(kinds[i % len(kinds)], item, where) for i, item in enumerate(value)]
    if not isinstance(value, float):
        if value is None or isinstance(value, bool | int | str):
            return value
        raise BadInputError(where, 'cannot be stored as JSON', type(value).__name__)
    if kind is float and not math.isfinite(value):
        raise BadInputError(where, 'must be finite', value)
    return value if math.isfinite(value) else None


def _read(kind: Any, tree: Any, where: str) -> Any:
    """A value of the declared type from JSON; raises BadInputError naming the field."""
    inner, build = get_args(kind), kind
    if type(None) in inner:
        return None if tree is None else _read(inner[0], tree, where)
    if is_dataclass(kind):
        field_names = {f.name for f in fields(kind)} - NOT_STORED
        return build(**_read_fields(kind, _keys(tree, where, field_names), where))
    reader = READERS.get(get_origin(kind) or kind)
    return tree if reader is None else reader(inner, tree, where)


def _text(_: Any, tree: Any, where: str) -> str:
    if not isinstance(tree, str):
        raise BadInputError(where, 'must be a string', tree)
    return tree


def _number(_: Any, tree: Any, where: str) -> float:
    if isinstance(tree, bool) or not isinstance(tree, int | float) or not math.isfinite(tree):
        raise BadInputError(where, 'must be a finite number', tree)
    return float(tree)


def _array(_: Any, tree: Any, where: str) -> FloatArray:
    """Numbers in lists of one length; null is NaN."""
    try:
        array = np.array(tree, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadInputError(where, 'must be numbers in lists of one length') from error
    array.setflags(write=False)
    return array


def _mapping(kinds: Any, tree: Any, where: str) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise BadInputError(where, 'must be an object', type(tree).__name__)
    return {str(key): _read(kinds[1], item, f'{where}.{key}') for key, item in tree.items()}


def _tuple(kinds: Any, tree: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(tree, list):
        raise BadInputError(where, 'must be a list', type(tree).__name__)
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(tree)
    if len(tree) != len(kinds):
        raise BadInputError(where, f'must be a list of {len(kinds)}', tree)
    names = [f'.{item["name"]}' if isinstance(item, dict) and 'name' in item else f'[{i}]'
             for i, item in enumerate(tree)]
    return tuple(_read(kind, item, where + name)
                 for kind, item, name in zip(kinds, tree, names, strict=True))


READERS: dict[Any, Callable[[Any, Any, str], Any]] = {
    str: _text, float: _number, int: lambda *args: int(_number(*args)), Mapping: _mapping,
    tuple: _tuple, np.ndarray: _array, npt.NDArray: _array,  # the origin from numpy 2.5 on
}
"""Readers by the declared type; values of other types are used as they are."""


def _read_fields(kind: Any, tree: Mapping[str, Any], where: str) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {name: _read(hints[name], item, f'{where}.{name}') for name, item in tree.items()}


def _keys(tree: object, where: str, names: set[str], *, more: bool = False) -> dict[str, Any]:
    """An object with all of these fields, and no others but where there may be `more`."""
    if not isinstance(tree, dict):
        raise BadInputError(where, 'must be an object', type(tree).__name__)
    missing = sorted(names - tree.keys() - OPTIONAL)
    if missing:
        raise BadInputError(where, f'lacks {", ".join(missing)}', remedy=AGAIN)
    unknown = sorted(tree.keys() - names)
    if unknown and not more:
        raise BadInputError(where, 'holds an unknown field', unknown[0], AGAIN)
    return tree
