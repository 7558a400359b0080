"""Gains in flash: a power cut at every byte leaves the old set or the new one."""

import subprocess

from probe import PATIENCE_S


def test_a_cut_at_every_byte_leaves_the_old_gains_or_the_new_ones(firmware):
    run = subprocess.run(
        [firmware('store')], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (run.returncode, run.stderr) == (0, '')
    assert int(run.stdout.split()[0]) > 5000
