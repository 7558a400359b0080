"""The YAML file of one aircraft's sensors: read, add, write. No maths."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from quad_bridge.errors import BadInputError
from quad_bridge.sensors.compass import HardIron
from quad_bridge.sensors.correction import Triple
from quad_bridge.sensors.rest import RestEstimate

ROOT = 'sensors'
NAME = 'sensors.yaml'
"""File in the aircraft's folder, beside the history of its gains, where the bridge reads it."""


def entry(found: RestEstimate | HardIron, when: datetime, source: str) -> dict[str, Any]:
    """The section of one estimate: its figures, time and bag."""
    numbers = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(found).items()}
    return {'measured': when.isoformat(timespec='seconds'), 'source': source, **numbers}


def three(
    sections: Mapping[str, Any], section: str, key: str, most: float = math.inf
) -> Triple | None:
    """A vector of a section; None where there is none.

    Raises BadInputError, also where a component is not within ±`most` (another unit).
    """
    part = sections.get(section)
    if not isinstance(part, dict) or key not in part:
        return None
    where, found = f'{ROOT}: {section}: {key}', part[key]
    try:
        x, y, z = map(_number, found if isinstance(found, list) else [])
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInputError(where, 'must be three numbers', reprlib.repr(found)) from error
    if not all(abs(v) <= most and math.isfinite(v) for v in (x, y, z)):
        bound = 'finite' if math.isinf(most) else f'within ±{most:g} (SI units)'
        raise BadInputError(where, f'must be {bound}', reprlib.repr(found))
    return x, y, z


def _number(value: Any) -> float:
    if isinstance(value, bool):
        raise TypeError
    return float(value)  # also of a text: YAML takes 1e-5, without a point, for one


def read(path: Path) -> dict[str, Any]:
    """Sections of the file; empty where it does not exist. Raises BadInputError."""
    if not path.exists():
        return {}
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise BadInputError(str(path), f'cannot be read ({error})', remedy='mend it') from error
    if not isinstance(content, dict) or not isinstance(content.get(ROOT), dict):
        raise BadInputError(str(path), f'has no section {ROOT}', remedy='give another --out')
    return dict(content[ROOT])


def write(path: Path, sections: Mapping[str, Any]) -> None:
    """Replace these sections of the file atomically; keep the others."""
    merged = {**read(path), **sections}
    part = path.with_name(f'{path.name}.part')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(yaml.safe_dump({ROOT: merged}, sort_keys=False), encoding='utf-8')
        part.replace(path)
    except OSError as error:
        raise BadInputError(str(path), f'cannot be written: {error.strerror}') from error
