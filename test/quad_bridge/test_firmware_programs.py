"""The firmware's own test programs (firmware/test), and the C that the documents show."""

import platform
import re
import sys
from pathlib import Path

import pytest
from node_process import ended

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / 'docs/firmware.md'
HEADER = ROOT / 'firmware/quad_endpoint.h'
PC = pytest.mark.skipif(platform.machine() != 'x86_64', reason='its registers lie on x86-64 only')
DEPTHS = ('frames used', 'bad', 'cycles excited', 'unsigned', 'forged', 'reverts')


def said(*command):
    run = ended(*command, timeout=1800)
    assert (run.returncode, run.stderr) == (0, ''), run.stdout
    return run.stdout


@pytest.mark.parametrize(
    ('target', 'says', 'least'),
    [
        ('store', 'cuts', 5000), ('chips', 'checks, 0 failed', 400),
        ('control', 'checks, 0 failed', 20_000), ('serial_radio', 'checks, 0 failed', 20_000),
        pytest.param('registers', 'cuts between accesses', 500, marks=PC)],
)
def test_it_ends_well(firmware, target, says, least):
    """Power cuts at every byte of a flash write; drivers by their datasheets; DMA, I2C, flash."""
    assert int(re.search(rf'(\d+) {says}', said(firmware(target)))[1]) > least


@pytest.mark.long
def test_no_receiver_takes_noise_for_its_pilot(firmware):
    """10^8 bytes, or edges, of noise and damage into each: SBUS, CRSF, IBUS, PPM, PWM."""
    assert ', 0 failed' in said(firmware('serial_radio'), '100000000')


@pytest.mark.parametrize(
    ('seed', 'number', 'least'),
    [(3, 1_000_000, 10), pytest.param(1, 100_000_000, 1000, marks=pytest.mark.long)],
)
def test_no_bytes_break_it(firmware, seed, number, least):
    told = said(firmware('fuzz'), str(seed), str(number))
    # it has come to the depths: frames heeded, excitation flown, gain sets taken back
    *used, reverts = (int(re.search(rf'(\d+) {word}', told)[1]) for word in DEPTHS)
    assert min(used) > least
    assert reverts > least // 50


def test_another_receiver_or_battery_builds_the_elf_anew(tmp_path):
    """By a compiler that only notes that it was called."""
    compiler = tmp_path / 'gcc'
    compiler.write_text(f'#!/bin/sh\necho >>{tmp_path}/calls\nfor name; do :; done\n: >"$name"\n')
    compiler.chmod(0o755)
    calls = []
    for chosen in ('RECEIVER=PPM', 'RECEIVER=SBUS', 'RECEIVER=SBUS', 'LOW_BATTERY_V=13.2'):
        said('make', '-s', '-C', str(ROOT / 'firmware'), f'PYTHON={sys.executable}', chosen,
             f'BUILD={tmp_path}', f'CROSS={tmp_path}/', f'{tmp_path}/flight.elf')
        calls.append(len((tmp_path / 'calls').read_text()))
    assert calls == [1, 2, 2, 3]


EXAMPLE = """#include "quad_endpoint.h"
void example(quad_endpoint e, const uint8_t *bytes, uint8_t *buffer, size_t count, size_t room,
             uint64_t now_us, quad_pilot pilot, quad_cycle record, quad_slow slow)
{{
    {}
    (void)count;
}}
"""
"""Around the calls with which the header opens."""


@pytest.mark.parametrize(
    ('page', 'excerpt', 'number', 'around'),
    [
        (PAGE, r'```c\n(.*?)```', 1, '{}'),
        (HEADER, r'(?m)^ \*     ((?:count = )?quad_\w+\(.*?\);)', 4, EXAMPLE),
    ],
)
def test_the_excerpts_compile(firmware, tmp_path, page, excerpt, number, around):
    blocks = re.findall(excerpt, page.read_text(encoding='utf-8'), re.DOTALL)
    assert len(blocks) >= number
    source = tmp_path / 'excerpts.c'
    source.write_text(around.format('\n'.join(blocks)), encoding='utf-8')
    headers = firmware('generated/quad_suite/mavlink.h').parents[1]
    said('gcc', '-std=c99', '-Wall', '-Wextra', '-Werror', '-Wno-address-of-packed-member',
         '-fsyntax-only', '-I', ROOT / 'firmware', '-isystem', headers, source)  # fmt: skip
