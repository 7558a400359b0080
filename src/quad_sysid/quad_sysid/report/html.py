"""report.html: one self-contained page from the report's tree and the answers behind it."""

from __future__ import annotations

import html as escape
from collections.abc import Mapping
from typing import Any

from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report.text import lines


def page(report: Mapping[str, Any], answers: Mapping[str, AxisAnswer]) -> str:
    """The page as text; `answers` bring the arrays that the pictures need."""
    del answers
    body = escape.escape('\n'.join(lines(report)))
    return f'<!doctype html><meta charset="utf-8"><title>quad-sysid</title><pre>{body}</pre>\n'
