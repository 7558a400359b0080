"""The committed dialect is what mavgen makes of the XML, and agrees with MAVLink's common."""

import json
import runpy
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from quad_bridge.wire import dialect

STANDARD = [number for number, message in dialect.mavlink_map.items()
            if number >= 0 and not message.msgname.startswith('QUAD_')]
MADE = runpy.run_path(str(Path(__file__).parents[2] / 'tools/dialect.py'))
WIRE_FIELDS = ('crc_extra', 'fieldnames', 'fieldtypes', 'array_lengths', 'orders')


def test_the_committed_dialect_is_generated_from_the_xml():
    assert MADE['DIALECT'].read_text(encoding='utf-8') == MADE['dialect_source']()


@pytest.mark.parametrize('number', STANDARD)
def test_standard_messages_are_those_of_common(number):
    ours, theirs = dialect.mavlink_map[number], ardupilotmega.mavlink_map.get(number)
    if theirs is None:  # this pymavlink leaves out what was "work in progress"
        assert (ours.msgname, ours.crc_extra) == ('ESC_STATUS', 10)
        return
    # TIMESYNC has gained addressee extensions in common: extensions are beside the checksum
    for name in WIRE_FIELDS:
        mine, other = getattr(ours, name), getattr(theirs, name)
        if isinstance(mine, list):
            other = other[: len(mine)]
        assert json.dumps(mine) == json.dumps(other), (ours.msgname, name)


def test_fastcrc_is_in_use():
    # the fall-back of the generated code is silent and three times slower
    assert dialect.x25crc is dialect._x25crc_fast
