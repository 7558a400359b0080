"""Schedules of the excitation as YAML files; what they mean stands in signals/schedule.py."""

from __future__ import annotations

from pathlib import Path

import yaml

from quad_sysid.errors import BadInputError
from quad_sysid.signals.schedule import Schedule, parse_schedule


def load_schedule(path: str | Path) -> Schedule:
    """Read and check a schedule; raises BadInputError naming file, segment and key."""
    source = str(path)
    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise BadInputError(source, f'cannot be read ({reason})',
                            remedy='give a schedule in YAML') from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # also endless digits, brackets
        mark = getattr(error, 'problem_mark', None)
        place = f'{source}, line {mark.line + 1}' if mark else source
        raise BadInputError(place, 'is not YAML', remedy='mend the syntax') from error
    return parse_schedule(content, source)
