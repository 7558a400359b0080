"""The C of docs/firmware.md compiles against the firmware, and its names are the wire's."""

import re
import subprocess
from pathlib import Path

from probe import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / 'docs/firmware.md').read_text(encoding='utf-8')


def compiled(firmware, source, text):
    """Compile against the firmware; what the compiler has to say."""
    headers = firmware('generated/quad_suite/mavlink.h').parents[1]
    source.write_text(text, encoding='utf-8')
    done = subprocess.run(
        ['gcc', '-std=c99', '-Wall', '-Wextra', '-Werror', '-Wno-address-of-packed-member',
         '-fsyntax-only', '-I', ROOT / 'firmware', '-isystem', headers, source],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    return done.stderr


def test_the_excerpts_compile(firmware, tmp_path):
    blocks = re.findall(r'```c\n(.*?)```', PAGE, re.DOTALL)
    assert blocks
    assert compiled(firmware, tmp_path / 'excerpts.c', '\n'.join(blocks)) == ''


EXAMPLE = """#include "quad_endpoint.h"
void example(quad_endpoint e, const uint8_t *bytes, uint8_t *buffer, size_t count, size_t room,
             uint64_t now_us, quad_pilot pilot, quad_cycle record, quad_slow slow)
{{
    {calls}
    (void)count;
}}
"""


def test_the_example_that_opens_the_header_compiles(firmware, tmp_path):
    text = (ROOT / 'firmware/quad_endpoint.h').read_text(encoding='utf-8')
    calls = re.findall(r'^ \*     ((?:count = )?quad_\w+\(.*?\);)', text, re.MULTILINE)
    assert len(calls) == 4
    text = EXAMPLE.format(calls='\n    '.join(calls))
    assert compiled(firmware, tmp_path / 'example.c', text) == ''


def test_every_message_that_it_names_exists():
    xml = (ROOT / 'src/quad_bridge/quad_bridge/wire/quad_suite.xml').read_text(encoding='utf-8')
    table = PAGE.split('## What goes over the wire')[1].split('## Timing')[0]
    named = {name for row in re.findall(r'^\| (`.*?) \|', table, re.MULTILINE)
             for name in re.findall(r'`([A-Z_]+)`', row)}  # fmt: skip
    assert len(named) == 10
    assert all(f'name="{name}"' in xml for name in named)
