"""What the benchmarks publish: the plants of each set as they were, the pages as their data."""

import hashlib
from pathlib import Path

from node_process import python

BENCH = Path(__file__).resolve().parents[2] / 'bench'


def test_a_set_of_effects_from_outside_stays_as_it_was_opened(monkeypatch):
    """The physics is grouped by family; set, place, rig and the seed of a flight may not move."""
    monkeypatch.syspath_prepend(str(BENCH))
    import outside

    assert sum(map(len, outside.FAMILIES.values())) == len(outside.PLANTS)  # no name twice
    for opened in outside.SETS:
        places = sorted(one.place for one in outside.PLANTS.values() if one.opened == opened)
        assert places == list(range(12))
    listed = '\n'.join(
        f'{case.opened} {case.effect} {case.strength} {case.seed} {case.axis} '
        f'{case.plant.rig} {" ".join(case.plant.may_be)}' for case in outside.cases('', 0.3)
    )
    assert hashlib.sha256(listed.encode()).hexdigest()[:16] == '2003647960205e68'


def test_the_pages_show_their_data():
    done = python(BENCH / 'results.py', '--check')
    assert (done.returncode, done.stdout) == (0, ''), done.stderr
