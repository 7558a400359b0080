"""Writes dialect.py from quad_suite.xml with pymavlink's mavgen.

`python src/quad_bridge/quad_bridge/wire/generate.py`, run by developers after a change of the XML
(as a file: the package imports what it writes); a test holds the committed file against the XML.
Nothing at run time imports this.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from pathlib import Path
from types import SimpleNamespace

from pymavlink.generator import mavgen

XML = Path(__file__).with_name('quad_suite.xml')
DIALECT = Path(__file__).with_name('dialect.py')


def dialect_source(xml: Path = XML) -> str:
    """Source text of the Python codec that mavgen makes of `xml` (MAVLink 2)."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / xml.with_suffix('.py').name
        options = SimpleNamespace(
            language='Python3',
            wire_protocol='2.0',
            output=str(output),
            validate=False,
            error_limit=1,
            strict_units=False,
        )
        with contextlib.redirect_stdout(io.StringIO()):
            mavgen.mavgen(options, [str(xml)])
        text = output.read_text(encoding='utf-8')
    return '\n'.join(line.rstrip() for line in text.splitlines()) + '\n'


if __name__ == '__main__':
    DIALECT.write_text(dialect_source(), encoding='utf-8')
