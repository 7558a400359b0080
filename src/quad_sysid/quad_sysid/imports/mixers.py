"""Motors of other frames and orders → the contract's: by name, by a file, by the motion.

Source of the contract's order and signs: eq. (7) of the paper, contract.MIXER.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import yaml

from quad_sysid.bags.cdr import MOTOR_NAMES
from quad_sysid.contract import AXES, MIXER_INVERSE, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.motor_layout import Pattern

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
SHIPPED = Path(__file__).with_name('mixer_files')
"""Mixer files that are known by their name alone."""


@dataclass(frozen=True)
class Mixer:
    """U = matrix @ motors."""

    name: str
    """Name for messages: `--mixer x`, or its place in the log."""
    matrix: FloatArray
    """(4, k): U1..U4 from k motors in the order in which they are given."""
    unsaid: tuple[str, ...] = ()
    """Axes whose signs the log does not state; the motion gives them, where certain."""

    def told_by(self, patterns: Sequence[Pattern]) -> Mixer:
        """The mixer with the motion's patterns for the axes in `unsaid`."""
        matrix = self.matrix.copy()
        for pattern in patterns:
            if pattern.axis in self.unsaid and pattern.certain:
                matrix[1 + AXES.index(pattern.axis)] = _signed_mean(pattern)
        return Mixer(self.name, matrix)

    @property
    def order(self) -> tuple[int, ...] | None:
        """Indices of the contract's motors 1..4; None where the matrix is not a permutation."""
        if self.matrix.shape != MIXER_INVERSE.shape:
            return None
        for order in permutations(range(4)):
            matrix = np.zeros((4, 4))
            matrix[:, list(order)] = MIXER_INVERSE
            if np.allclose(matrix, self.matrix):
                return order
        return None


def shipped() -> list[str]:
    """Names of the mixer files that come with the package."""
    return sorted(file.stem for file in SHIPPED.glob('*.yaml'))


def mixer_of_patterns(patterns: Sequence[Pattern], motors: int) -> Mixer:
    """U1 as the mean of the motors, U2..U4 as signed means; 0 without a pattern."""
    matrix = np.zeros((4, motors))
    matrix[0] = 1.0 / motors
    for pattern in patterns:
        matrix[1 + AXES.index(pattern.axis)] = _signed_mean(pattern)
    return Mixer('--mixer auto', matrix)


def _signed_mean(pattern: Pattern) -> FloatArray:
    signs = np.array(pattern.signs, dtype=float)
    return np.asarray(signs / np.abs(signs).sum())


def mixer_of(name: str, columns: Sequence[str]) -> Mixer:
    """Mixer by name or file; raises BadInputError naming file and field.

    A file is YAML with `columns: {motor_1: COL, …}` (the contract's motors by column) or
    `matrix:` of 4 rows U1..U4 by as many columns as --motors has; or CSV with lines `motor_1,COL`.
    """
    if name in ('x', 'plus') and len(columns) != 4:
        raise BadInputError(
            f'--mixer {name}', 'is one of four motors', f'{len(columns)} columns in --motors',
            'use --mixer auto, or a file with a matrix of 4 rows',
        )
    if name == 'x':
        return Mixer('--mixer x', MIXER_INVERSE)
    if name == 'plus':
        return Mixer('--mixer plus', PLUS)
    file = SHIPPED / f'{name}.yaml' if name in shipped() else Path(name)
    try:
        text = file.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(
            f'--mixer {name}', 'is not a mixer and cannot be read as a file',
            remedy=f'use auto, x, plus, {", ".join(shipped())} or a YAML file with columns: or '
            'matrix:',
        ) from error
    return _of_text(text, file, columns, name)


def _of_text(text: str, file: Path, columns: Sequence[str], name: str) -> Mixer:
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
    if matrix.shape != (4, len(columns)) or not np.isfinite(matrix).all():
        raise BadInputError(
            name, f'matrix needs 4 rows of {len(columns)} finite numbers', remedy='mend it'
        )
    return Mixer(f'--mixer {name}', matrix)


def _by_columns(mapping: object, columns: Sequence[str], source: str) -> Mixer:
    if not isinstance(mapping, dict) or sorted(map(str, mapping)) != sorted(MOTOR_NAMES):
        raise BadInputError(source, f'columns needs the keys {", ".join(MOTOR_NAMES)}', mapping)
    given = [str(mapping[motor]) for motor in MOTOR_NAMES]
    if sorted(given) != sorted(columns):
        raise BadInputError(
            source, 'columns names others than --motors', ', '.join(given),
            f'--motors has {", ".join(columns)}',
        )
    matrix = np.zeros((4, 4))
    matrix[:, [list(columns).index(column) for column in given]] = MIXER_INVERSE
    return Mixer(f'--mixer {source}', matrix)
