"""Motors of other frames and orders → the contract's: `x`, `plus`, `crazyflie` or a small file.

Source of the contract's order and signs: eq. (7) of the paper, contract.MIXER.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from quad_sysid.bags.cdr import MOTOR_NAMES
from quad_sysid.contract import MIXER_INVERSE, FloatArray
from quad_sysid.errors import BadInputError

PLUS: FloatArray = np.array(
    [
        [0.25, 0.25, 0.25, 0.25],
        [0.0, -0.5, 0.0, 0.5],
        [-0.5, 0.0, 0.5, 0.0],
        [0.25, -0.25, 0.25, -0.25],
    ]
)
"""U1..U4 from the motors front, right, rear, left of a plus frame (FLU: positive roll lifts the
left, positive pitch lowers the nose; front and rear turn clockwise seen from above)."""
PLUS.setflags(write=False)
SHIPPED = Path(__file__).with_name('frames')
"""Mixer files that are known by their name alone."""


@dataclass(frozen=True)
class Mixer:
    """`order`: which given column is motor 1..4; without it U = matrix @ motors."""

    matrix: FloatArray
    """(4, 4): U1..U4 from the motors in the order in which the columns are given."""
    order: tuple[int, ...] | None = None


def shipped() -> list[str]:
    """Names of the mixer files that come with the package."""
    return sorted(file.stem for file in SHIPPED.glob('*.yaml'))


def mixer_of(name: str, columns: Sequence[str]) -> Mixer:
    """Mixer by name or file; raises BadInputError naming file and field.

    A file is YAML with `columns: {motor_1: COL, …}` (the contract's motors by column) or
    `matrix:` of 4 rows U1..U4 by 4 columns as in --motors; or CSV with lines `motor_1,COL`.
    """
    if name == 'x':
        return Mixer(MIXER_INVERSE, (0, 1, 2, 3))
    if name == 'plus':
        return Mixer(PLUS)
    file = SHIPPED / f'{name}.yaml' if name in shipped() else Path(name)
    try:
        text = file.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(
            f'--mixer {name}', 'is no mixer and cannot be read as a file',
            remedy=f'use x, plus, {", ".join(shipped())} or a YAML file with columns: or matrix:',
        ) from error
    if file.suffix == '.csv':
        pairs = [line.split(',', 1) for line in text.splitlines() if ',' in line]
        return _by_columns({key.strip(): value.strip() for key, value in pairs}, columns, name)
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadInputError(name, 'is not YAML', remedy='mend it') from error
    if not isinstance(content, dict) or {*content} not in ({'columns'}, {'matrix'}):
        raise BadInputError(
            name, 'needs exactly one of the keys columns and matrix',
            ', '.join(map(str, content)) if isinstance(content, dict) else type(content).__name__,
            f'{SHIPPED / "crazyflie.yaml"} is an example',
        )
    if 'columns' in content:
        return _by_columns(content['columns'], columns, name)
    try:
        matrix = np.array(content['matrix'], dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise BadInputError(name, 'matrix needs 4 rows of 4 finite numbers', remedy='mend it')
    return Mixer(matrix)


def _by_columns(mapping: object, columns: Sequence[str], source: str) -> Mixer:
    if not isinstance(mapping, dict) or sorted(map(str, mapping)) != sorted(MOTOR_NAMES):
        raise BadInputError(source, f'columns needs the keys {", ".join(MOTOR_NAMES)}', mapping)
    given = [str(mapping[motor]) for motor in MOTOR_NAMES]
    if sorted(given) != sorted(columns):
        raise BadInputError(
            source, 'columns names others than --motors', ', '.join(given),
            f'--motors has {", ".join(columns)}',
        )
    order = tuple(list(columns).index(column) for column in given)
    matrix = np.zeros((4, 4))
    matrix[:, list(order)] = MIXER_INVERSE
    return Mixer(matrix, order)
