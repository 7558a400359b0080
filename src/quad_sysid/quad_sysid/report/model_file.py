"""model.json: identified models on disk and back, strictly checked: grey boxes and black boxes.

Schema quad_sysid/model/2. NaN is not JSON: a covariance row held at a bound and a standard error
that does not exist are stored as null. What a model means stands in quad_sysid/model; nothing is
fitted or judged here.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.blackbox import Model
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.json_file import read_json
from quad_sysid.model import AxisModel, EffectEstimate, NoiseEstimate, Parameter
from quad_sysid.model.effect import Effect

POLYNOMIALS = ('A', 'B', 'C', 'D', 'F')


def tree_of(model: Model) -> dict[str, Any]:
    """A polynomial model as plain values; B with its leading zeros, covariance null if unknown."""
    covariance = model.covariance
    known = covariance is not None and bool(np.isfinite(covariance).all())
    return {
        'structure': model.structure,
        'orders': {name: int(value) for name, value in model.orders.items()},
        'approach': model.approach,
        **{name: [float(x) for x in getattr(model, name)] for name in POLYNOMIALS},
        'nk': int(model.nk),
        'dt': float(model.dt),
        'noise_variance': float(model.noise_variance),
        'parameter_names': list(model.parameter_names),
        'covariance': covariance.tolist() if known and covariance is not None else None,
    }


def load_blackbox(path: str | os.PathLike[str]) -> dict[str, Model]:
    """The black-box models of a model.json by axis; empty where it holds none.

    Raises BadInputError naming file and field where they cannot be read.
    """
    tree = read_json(path)
    axes = tree.get('blackbox', {}) if isinstance(tree, dict) else {}
    if not isinstance(axes, dict):
        raise BadInputError(f'{path}: blackbox', 'must be an object', type(axes).__name__)
    return {axis: _model_of(one, f'{path}: blackbox.{axis}') for axis, one in axes.items()}


def _model_of(tree: Mapping[str, Any], where: str) -> Model:
    try:
        a, b, c, d, f = (np.asarray(tree[name], dtype=float) for name in POLYNOMIALS)
        model = Model(
            structure=str(tree['structure']),
            orders={str(name): int(value) for name, value in tree['orders'].items()},
            approach=str(tree['approach']), nk=int(tree['nk']), dt=float(tree['dt']),
            noise_variance=float(tree['noise_variance']), covariance=tree['covariance'],
            A=a, B=b, C=c, D=d, F=f,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInputError(where, 'is not a polynomial model', repr(error)) from error
    p = model.parameters.size
    for name in POLYNOMIALS:
        poly = getattr(model, name)
        if poly.ndim != 1 or not poly.size or not np.isfinite(poly).all():
            raise BadInputError(f'{where}.{name}', 'must be a list of finite numbers')
        if name != 'B' and poly[0] != 1.0:
            raise BadInputError(f'{where}.{name}', 'must start with 1', float(poly[0]))
    if not (math.isfinite(model.dt) and model.dt > 0.0):
        raise BadInputError(f'{where}.dt', 'must be a positive number of seconds', model.dt)
    if model.covariance is not None and model.covariance.shape != (p, p):
        raise BadInputError(f'{where}.covariance', f'must be {p} by {p}', model.covariance.shape)
    return model


SCHEMA = 'quad_sysid/model/2'
BASE_NAMES = ('gain', 'lag', 'delay', 'damping', 'bias')
_MODEL_KEYS = frozenset(
    {
        'dt', 'gyro_filter_hz', 'base', 'effects', 'parameter_names', 'covariance',
        'active_gains', 'mean_battery_v', 'noise', 'trusted_band_rad_s', 'plain', 'plain_noise',
    }
)  # fmt: skip
_EFFECT_KEYS = frozenset(
    {
        'name', 'kind', 'signals', 'parameters', 'variant', 'settings', 'p_value',
        'error_reduction_pct', 'probability', 'rivals',
    }
)  # fmt: skip
_NOISE_NUMBERS = ('scale', 'degrees', 'gyro_rms', 'measured_rms')
_PARAMETER_KEYS = frozenset({'name', 'value', 'std', 'unit'})


def save_models(
    models: Mapping[str, AxisModel], path: str | os.PathLike[str],
    blackbox: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write the models of a flight, by axis, to `path`; the file is replaced whole or not at all.

    `blackbox`: trees of the selected black-box models by axis. Raises
    BadInputError where a number that must be finite is not, or the file can't be written.
    """
    target = Path(path)
    axes = {axis: _model_out(model, f'{target}: {axis}') for axis, model in models.items()}
    tree = {'schema': SCHEMA, 'axes': axes, **({'blackbox': blackbox} if blackbox else {})}
    text = json.dumps(tree, indent=1, allow_nan=False) + '\n'
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(
            dir=target.parent, prefix=f'.{target.name}.', suffix='.part'
        )
        with os.fdopen(handle, 'w', encoding='utf-8') as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(target)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise BadInputError(str(target), 'cannot be written', error.strerror) from error


def load_models(
    path: str | os.PathLike[str], own_effects: Sequence[Effect] = ()
) -> dict[str, AxisModel]:
    """Models by axis from a model.json; raises BadInputError naming file, field and remedy.

    `own_effects`: those that the models may name beside the package's.
    """
    name = str(path)
    tree = read_json(path, 'give the model.json of quad-sysid identify')
    root = _object(tree, name, frozenset({'schema', 'axes'}), open_ended=True)
    if root['schema'] != SCHEMA:
        raise BadInputError(
            f'{name}: schema', f'must be {SCHEMA}', root['schema'],
            'give the model.json of quad-sysid identify',
        )  # fmt: skip
    axes = root['axes']
    if not isinstance(axes, dict) or not axes:
        raise BadInputError(f'{name}: axes', 'must be an object with at least one axis', axes)
    for axis in axes:
        if axis not in AXES:
            raise BadInputError(f'{name}: axes', f'must be of {", ".join(AXES)}', axis)
    return {
        axis: replace(
            _model_in(axis, tree, f'{name}: axes.{axis}'), own_effects=tuple(own_effects)
        )
        for axis, tree in axes.items()
    }


def _model_out(model: AxisModel, where: str) -> dict[str, Any]:
    covariance = None
    if model.covariance is not None:
        covariance = [[_null(float(v)) for v in row] for row in np.asarray(model.covariance)]
    band = model.trusted_band_rad_s
    return {
        'dt': _finite(model.dt, f'{where}.dt'),
        'gyro_filter_hz': _null(model.gyro_filter_hz),
        'base': [_parameter_out(p, f'{where}.base') for p in model.base],
        'effects': [_effect_out(e, f'{where}.effects.{e.name}') for e in model.effects],
        'parameter_names': list(model.parameter_names),
        'covariance': covariance,
        'active_gains': {
            key: _finite(value, f'{where}.active_gains.{key}')
            for key, value in model.active_gains.items()
        },
        'mean_battery_v': _null(model.mean_battery_v),
        'noise': _noise_out(model.noise, f'{where}.noise'),
        'trusted_band_rad_s': (
            None if band is None else [_finite(v, f'{where}.trusted_band_rad_s') for v in band]
        ),
        'plain': [_parameter_out(p, f'{where}.plain') for p in model.plain],
        'plain_noise': _noise_out(model.plain_noise, f'{where}.plain_noise'),
    }


def _noise_out(noise: NoiseEstimate | None, where: str) -> dict[str, Any] | None:
    if noise is None:
        return None
    return {
        'ratios': {
            name: _finite(value, f'{where}.{name}') for name, value in noise.ratios.items()
        },
        **{name: _finite(getattr(noise, name), f'{where}.{name}') for name in _NOISE_NUMBERS},
        'lines': [[_finite(v, f'{where}.lines') for v in line] for line in noise.lines],
    }


def _parameter_out(parameter: Parameter, where: str) -> dict[str, Any]:
    return {
        'name': parameter.name,
        'value': _finite(parameter.value, f'{where}.{parameter.name}'),
        'std': _null(parameter.std),
        'unit': parameter.unit,
    }


def _effect_out(effect: EffectEstimate, where: str) -> dict[str, Any]:
    return {
        'name': effect.name,
        'kind': effect.kind,
        'signals': list(effect.signals),
        'parameters': [_parameter_out(p, where) for p in effect.parameters],
        'variant': effect.variant,
        'settings': {key: _plain(v, f'{where}.settings') for key, v in effect.settings.items()},
        'p_value': _finite(effect.p_value, f'{where}.p_value'),
        'error_reduction_pct': _finite(effect.error_reduction_pct, f'{where}.error_reduction_pct'),
        'probability': _finite(effect.probability, f'{where}.probability'),
        'rivals': [[name, _finite(p, f'{where}.rivals')] for name, p in effect.rivals],
    }


def _plain(value: object, where: str) -> Any:
    """`value` as JSON: arrays and tuples become lists, NaN null."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), where)
    if isinstance(value, float):
        return _null(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item, where) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(item, where) for item in value]
    raise BadInputError(where, 'cannot be stored as JSON', type(value).__name__)


def _null(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _finite(value: float, where: str) -> float:
    if not math.isfinite(value):
        raise BadInputError(where, 'must be finite', value)
    return float(value)


def _model_in(axis: str, tree: object, where: str) -> AxisModel:
    fields = _object(tree, where, _MODEL_KEYS)
    base = _parameters_in(fields['base'], f'{where}.base')
    names = [p.name for p in base]
    if sorted(names) != sorted(BASE_NAMES):
        found = ', '.join(names)
        raise BadInputError(f'{where}.base', f'must list {", ".join(BASE_NAMES)}', found)
    parameter_names = _strings(fields['parameter_names'], f'{where}.parameter_names')
    band = fields['trusted_band_rad_s']
    if band is not None:
        low, high = _pair(band, f'{where}.trusted_band_rad_s')
        band = (_number(low, f'{where}.trusted_band_rad_s'),
                _number(high, f'{where}.trusted_band_rad_s'))  # fmt: skip
    dt = _number(fields['dt'], f'{where}.dt')
    if dt <= 0:
        raise BadInputError(f'{where}.dt', 'must be a positive number of seconds', dt)
    gains = fields['active_gains']
    if not isinstance(gains, dict):
        raise BadInputError(f'{where}.active_gains', 'must be an object of numbers', gains)
    effects = _list(fields['effects'], f'{where}.effects')
    return AxisModel(
        axis=axis,
        dt=dt,
        gyro_filter_hz=_optional(fields['gyro_filter_hz'], f'{where}.gyro_filter_hz'),
        base=base,
        effects=tuple(_effect_in(e, f'{where}.effects[{i}]') for i, e in enumerate(effects)),
        parameter_names=parameter_names,
        covariance=_covariance_in(fields['covariance'], parameter_names, f'{where}.covariance'),
        active_gains={k: _number(v, f'{where}.active_gains.{k}') for k, v in gains.items()},
        mean_battery_v=_optional(fields['mean_battery_v'], f'{where}.mean_battery_v'),
        noise=_noise_in(fields['noise'], f'{where}.noise'),
        trusted_band_rad_s=band,
        plain=_parameters_in(fields['plain'], f'{where}.plain'),
        plain_noise=_noise_in(fields['plain_noise'], f'{where}.plain_noise'),
    )


def _noise_in(tree: object, where: str) -> NoiseEstimate | None:
    if tree is None:
        return None
    found = _object(tree, where, frozenset({'ratios', 'lines', *_NOISE_NUMBERS}))
    if not isinstance(found['ratios'], dict):
        raise BadInputError(f'{where}.ratios', 'must be an object of numbers', found['ratios'])
    lines = [_numbers(one, f'{where}.lines') for one in _list(found['lines'], where)]
    if any(len(one) != 3 for one in lines):
        raise BadInputError(f'{where}.lines', 'must hold size, frequency and width of each', lines)
    positive = {
        name: _number(value, f'{where}.{name}')
        for name, value in (
            *found['ratios'].items(), *((name, found[name]) for name in _NOISE_NUMBERS)
        )
    }
    for name, value in positive.items():
        if not value > 0.0:
            raise BadInputError(f'{where}.{name}', 'must be positive', value)
    return NoiseEstimate(
        ratios={name: positive[name] for name in found['ratios']},
        **{name: positive[name] for name in _NOISE_NUMBERS},
        lines=tuple((a, f, w) for a, f, w in lines),
    )


def _parameters_in(tree: object, where: str) -> tuple[Parameter, ...]:
    parameters = []
    for index, item in enumerate(_list(tree, where)):
        fields = _object(item, f'{where}[{index}]', _PARAMETER_KEYS)
        name = _string(fields['name'], f'{where}[{index}].name')
        parameters.append(
            Parameter(
                name=name,
                value=_number(fields['value'], f'{where}.{name}.value'),
                std=_optional(fields['std'], f'{where}.{name}.std'),
                unit=_string(fields['unit'], f'{where}.{name}.unit'),
            )
        )
    return tuple(parameters)


def _effect_in(tree: object, where: str) -> EffectEstimate:
    fields = _object(tree, where, _EFFECT_KEYS)
    if not isinstance(fields['settings'], dict):
        raise BadInputError(f'{where}.settings', 'must be an object', fields['settings'])
    rivals = [_pair(item, f'{where}.rivals') for item in _list(fields['rivals'], where)]
    return EffectEstimate(
        name=_string(fields['name'], f'{where}.name'),
        kind=_string(fields['kind'], f'{where}.kind'),
        signals=_strings(fields['signals'], f'{where}.signals'),
        parameters=_parameters_in(fields['parameters'], f'{where}.parameters'),
        variant=_string(fields['variant'], f'{where}.variant'),
        settings=fields['settings'],
        p_value=_number(fields['p_value'], f'{where}.p_value'),
        error_reduction_pct=_number(fields['error_reduction_pct'], f'{where}.error_reduction_pct'),
        probability=_number(fields['probability'], f'{where}.probability'),
        rivals=tuple(
            (_string(name, f'{where}.rivals'), _number(p, f'{where}.rivals')) for name, p in rivals
        ),
    )


def _covariance_in(tree: object, names: Sequence[str], where: str) -> FloatArray | None:
    if tree is None:
        return None
    rows = [_list(row, where) for row in _list(tree, where)]
    if any(len(row) != len(names) for row in rows) or len(rows) != len(names):
        raise BadInputError(where, f'must be {len(names)} by {len(names)}, as parameter_names say')
    matrix = np.array(
        [[np.nan if v is None else _number(v, where) for v in row] for row in rows], dtype=float
    ).reshape(len(names), len(names))
    matrix.setflags(write=False)
    return matrix


def _object(
    tree: object, where: str, keys: frozenset[str], *, open_ended: bool = False
) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise BadInputError(where, 'must be an object', type(tree).__name__)
    missing = sorted(keys - tree.keys())
    if missing:
        raise BadInputError(where, f'lacks {", ".join(missing)}',
                            remedy='identify again with this version')
    unknown = sorted(tree.keys() - keys)
    if unknown and not open_ended:
        raise BadInputError(where, 'holds an unknown field', unknown[0],
                            'identify again with this version')
    return tree


def _list(tree: object, where: str) -> list[Any]:
    if not isinstance(tree, list):
        raise BadInputError(where, 'must be a list', type(tree).__name__)
    return tree


def _pair(tree: object, where: str) -> tuple[Any, Any]:
    items = _list(tree, where)
    if len(items) != 2:
        raise BadInputError(where, 'must be a pair', items)
    return items[0], items[1]


def _string(tree: object, where: str) -> str:
    if not isinstance(tree, str):
        raise BadInputError(where, 'must be a string', tree)
    return tree


def _strings(tree: object, where: str) -> tuple[str, ...]:
    return tuple(_string(item, where) for item in _list(tree, where))


def _number(tree: object, where: str) -> float:
    if isinstance(tree, bool) or not isinstance(tree, int | float) or not math.isfinite(tree):
        raise BadInputError(where, 'must be a finite number', tree)
    return float(tree)


def _numbers(tree: object, where: str) -> tuple[float, ...]:
    return tuple(_number(item, where) for item in _list(tree, where))


def _optional(tree: object, where: str) -> float | None:
    return None if tree is None else _number(tree, where)
