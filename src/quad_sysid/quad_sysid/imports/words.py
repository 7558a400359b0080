"""The table of an import for a terminal of 80 columns: what was mapped, what is missing."""

from __future__ import annotations

import textwrap

from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.to_bag import Imported

WIDTH = 79


def table(done: Imported) -> list[str]:
    """Lines to print after an import."""
    record = done.record
    out = [
        str(done.path),
        (f'{done.log.kind}, {record.n} samples at {1.0 / record.dt:.5g} Hz, '
         f'{record.n * record.dt:.1f} s'), '', *mapped(done.log),
    ]
    for title, lines in (('clock and motors', done.told), ('missing', done.log.missing),
                         ('warnings', done.warnings)):
        if lines:
            out += ['', title, *(part for line in lines for part in _wrapped(line, '  '))]
    return out


def mapped(log: ForeignLog) -> list[str]:
    """The table of fields: from the log, to the bag."""
    out = [f'{"from the log":<36} {"Hz":>6}  to the bag']
    for m in log.mapped:
        rate = f'{m.rate_hz:.4g}' if m.rate_hz else '-'
        out.append(f'{f"{m.source} [{m.unit}]":<36} {rate:>6}  {m.topic}')
        out += _wrapped(m.how, '      ') if m.how else []
    return out


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent + '  ',
                         break_on_hyphens=False)
