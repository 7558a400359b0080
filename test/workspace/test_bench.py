"""What the benchmarks publish: the plants of each set as they were, the pages as their data."""

import hashlib
import subprocess
import sys
from pathlib import Path

from node_process import python, until

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


def test_the_judge_takes_no_wrong_answer_for_a_right_one(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCH))
    from effects_judge import extra as also
    from effects_judge import on_two_rungs, right, summary, wrong_names

    def row(kind, planted, named, p=0.9, factor=2.0):
        return {
            'kind': kind, 'planted': planted, 'named': named, 'probabilities': [p] * len(named),
            'rivals': [[[name, p], ['backlash', 1.0 - p]] for name in named], 'factor': factor,
            'rungs': [named[:k] for k in range(len(named) + 1)], 'covered': {}, 'number': 0,
            'lost': factor, 'before': factor, 'after': 1.0, 'true': 1.0, 'seconds': 1.0,
            'verdict': 'effects_added' if named else 'no_missing_effect',
        }

    both = ['coulomb_friction', 'quadratic_drag']
    for named, all_there, more in (
        (both, True, False), (both[:1], False, False), ([], False, False),
        ([*both, 'shape:rate'], True, True), (['mode:lead'], False, True),
    ):
        pair = row('pair', both, named)
        assert (right(pair), also(pair)) == (all_there, more), named
    assert on_two_rungs(row('pair', both, ['shape:rate', *both])) is False
    for planted, name, p, lies in (
        ('detents', 'coulomb_friction', 0.9, True), ('detents', 'coulomb_friction', 0.4, False),
        ('stribeck', 'coulomb_friction', 0.9, False), ('stribeck', 'quadratic_drag', 0.9, True),
        ('detents', 'shape:angle', 0.9, False),
    ):
        assert bool(wrong_names(row('undeclared', [planted], [name], p))) == lies
    found = summary([
        row('named', both[:1], both[:1]), row('named', both[:1], []),
        row('named', both[:1], [], factor=1.4),  # too weak to count
        row('nothing', [], both[:1], factor=1.0), row('undeclared', ['detents'], []),
    ])
    assert found['named'] == {'n': 2, 'share': 0.5}
    assert (found['nothing'], found['nothing_effects_added']) == (1, 1)
    assert (found['undeclared'], found['undeclared_not_silent']) == (1, 0.0)
    # 0.9 for what is there and for what is not, and 0.1 for a rival of each
    assert abs(found['brier'] - (0.01 + 0.01 + 0.81 + 0.01) / 4.0) < 1e-12


def test_the_pages_show_their_data():
    done = python(BENCH / 'results.py', '--check')
    assert (done.returncode, done.stdout) == (0, ''), done.stderr


def test_workers_end_with_a_benchmark_that_is_killed(tmp_path):
    """Also in the middle of a task, and while they wait for one."""
    script = tmp_path / 'some.py'
    script.write_text(f"""
import os, sys, time
sys.path.insert(0, {str(BENCH)!r})
import workers
if __name__ == '__main__':
    with workers.pool(2) as pool:
        sleeps = pool.submit(time.sleep, 10_000)
        pool.submit(os.getpid).result()
        print(flush=True)
        sleeps.result()
""")
    bench = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    bench.stdout.readline()
    children = Path(f'/proc/{bench.pid}/task/{bench.pid}/children').read_text().split()
    assert len(children) > 2  # and one that tracks what they share
    bench.kill()
    bench.communicate()

    def runs(number):
        try:
            return Path('/proc', number, 'cmdline').read_bytes()  # empty where nobody reaps it
        except OSError:
            return b''

    until(lambda: not any(map(runs, children)), children)
