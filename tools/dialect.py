"""Writes dialect.py from quad_suite.xml with pymavlink's mavgen.

`python tools/dialect.py`, run by developers after a change of the XML; a test holds the committed
file against the XML.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree as ET

from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.generator import mavgen

WIRE = Path(__file__).resolve().parents[1] / 'src/quad_bridge/quad_bridge/wire'
XML, DIALECT = WIRE / 'quad_suite.xml', WIRE / 'dialect.py'
_HEAD = """
OTHER_MESSAGES: Dict[int, Tuple[str, int]] = {
    # standard messages without a use here: id, name, CRC_EXTRA; with these their checksums can be
    # verified, so that nothing inside them is taken for a frame
"""


def dialect_source(xml: Path = XML) -> str:
    """Source that mavgen makes of `xml` (MAVLink 2), with the table of all other messages."""
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
    return '\n'.join(line.rstrip() for line in text.splitlines()) + '\n' + others_source()


def others_source() -> str:
    """Source text of the table: what ArduPilot's dialect (common's superset) has beside ours."""
    root = ET.parse(XML).getroot()  # noqa: S314  (our own file)
    own = root.iterfind('messages/message')
    taken = {int(message.get('id', '-1')) for message in own}
    lines = [
        f"    {number}: ('{message.msgname}', {message.crc_extra}),\n"
        for number, message in sorted(ardupilotmega.mavlink_map.items())
        if number >= 0 and number not in taken
    ]
    return _HEAD + ''.join(lines) + '}\n'


if __name__ == '__main__':
    DIALECT.write_text(dialect_source(), encoding='utf-8')
