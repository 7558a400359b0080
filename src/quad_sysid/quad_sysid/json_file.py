"""A JSON file as plain values, or in one line why not. What its values mean its readers know."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError


def read_json(path: str | os.PathLike[str], remedy: str = '') -> Any:
    """The content of a file; `remedy` for one that cannot be opened. Raises BadInputError."""
    try:
        return json.loads(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise BadInputError(str(path), 'cannot be read', error.strerror, remedy) from error
    except (ValueError, RecursionError) as error:  # no text, no JSON, endless digits or brackets
        raise BadInputError(str(path), 'is not JSON', str(error),
                            'give a file that quad-sysid or quad-tune wrote') from error
