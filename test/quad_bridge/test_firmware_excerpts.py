"""The C of docs/firmware.md compiles against the endpoint, and its names are the wire's."""

import re
import subprocess
from pathlib import Path

from probe import PATIENCE_S

from quad_bridge.gains.table import WIRE_NAMES

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / 'docs/firmware.md').read_text(encoding='utf-8')


def test_the_excerpts_compile(firmware, tmp_path):
    headers = firmware('generated/quad_suite/mavlink.h').parents[1]
    blocks = re.findall(r'```c\n(.*?)```', PAGE, re.DOTALL)
    assert len(blocks) >= 2
    source = tmp_path / 'excerpts.c'
    source.write_text('\n'.join(blocks), encoding='utf-8')
    done = subprocess.run(
        ['gcc', '-std=c99', '-Wall', '-Wextra', '-Werror', '-Wno-address-of-packed-member',
         '-fsyntax-only', '-I', ROOT / 'firmware', '-isystem', headers, source],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_the_parameters_that_it_names_exist():
    named = re.findall(r'`((?:ROLL|GYRO|ACC|LOOP)_[A-Z_]+)`', PAGE)
    assert len(named) == 23
    assert set(named) <= set(WIRE_NAMES.values())


def test_every_message_that_it_names_exists():
    xml = (ROOT / 'src/quad_bridge/quad_bridge/wire/quad_suite.xml').read_text(encoding='utf-8')
    table = PAGE.split('## What goes over the wire')[1].split('## Timing')[0]
    named = {name for row in re.findall(r'^\| (`.*?) \|', table, re.MULTILINE)
             for name in re.findall(r'`([A-Z_]+)`', row)}  # fmt: skip
    assert len(named) == 10
    assert all(f'name="{name}"' in xml for name in named)
