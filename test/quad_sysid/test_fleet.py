"""A fleet loses nothing: bad bags and dead processes are rows, a second call does the rest."""

from __future__ import annotations

import csv
import json
import os

import numpy as np
import pytest
from flown_axis import Axis, Plan, fly

from quad_sysid import fleets as fleet
from quad_sysid.bags import write_bag
from quad_sysid.cli import main


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two aircraft with a flight each, and two things that are no flights."""
    plan = Plan(26.0, (('train', 'prbs', 0.0, 15.0), ('validation', 'prbs', 15.0, 26.0)))
    root = tmp_path_factory.mktemp('fleet')
    for number, (craft, gain) in enumerate((('one', 450.0), ('two', 500.0))):
        write_bag(fly(Axis(gain=gain), number, plan), root / craft / 'flight')
    (root / 'two' / 'torn').mkdir()
    (root / 'two' / 'torn' / 'torn_0.mcap').write_bytes(b'noise')
    (root / 'notes.txt').write_text('no bag')
    return root


def test_bags_are_found_with_their_aircraft(folder, tmp_path, refusal):
    found = [(job.name, job.aircraft) for job in fleet.jobs(folder, tmp_path)]
    assert found == [('one/flight', 'one'), ('two/flight', 'two'), ('two/torn', 'two')]
    assert 'is not a folder' in refusal(fleet.jobs, folder / 'nowhere', tmp_path)
    assert 'holds no bag' in refusal(fleet.jobs, tmp_path, tmp_path)


def test_a_fleet_through_the_command_and_on_from_there(folder, tmp_path, capsys):
    out = tmp_path / 'out'
    arguments = ['fleet', str(folder), '--out', str(out), '--no-effects', '--workers', '2']
    assert main([*arguments, '--json']) == 0
    rows = {row['bag']: row for row in json.loads(capsys.readouterr().out)}
    assert [rows[b]['status'] for b in ('one/flight', 'two/flight', 'two/torn')] == [
        'answered', 'answered', 'failed'
    ]
    # the true gains are 450 and 500; 20 s of training tell them within some per cent
    assert rows['one/flight']['roll_gain'] == pytest.approx(450.0, rel=0.04)
    assert rows['two/flight']['roll_gain'] == pytest.approx(500.0, rel=0.04)
    assert 'neither mcap nor sqlite3' in rows['two/torn']['reason']
    with (out / 'fleet.csv').open() as stream:
        told = {row['bag']: row['roll_gain'] for row in csv.DictReader(stream)}
    assert told == {name: str(row.get('roll_gain', '')) for name, row in rows.items()}
    assert (out / 'bags' / 'two' / 'flight' / 'report.json').exists()
    # a second call tries the failed bag alone, and prints the table within 80 columns
    before = {path: path.stat().st_mtime_ns for path in out.rglob('row.json')}
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob('row.json')}
    assert len(before) == 2
    assert max(len(line) for line in shown.splitlines()[:-1]) <= 80
    assert '2 answered, 1 failed' in shown


def test_a_dead_process_is_a_row_and_the_rest_go_on(folder, tmp_path, monkeypatch):
    (tmp_path / 'deadly.py').write_text(
        'import os\ndef work(job):\n'
        "    return os._exit(1) if 'torn' in job.name else {'bag': job.name, 'status': 'answered'}"
    )
    monkeypatch.syspath_prepend(tmp_path)
    from deadly import work

    rows = fleet.run(fleet.jobs(folder, tmp_path), work=work)
    assert [row['status'] for row in rows] == ['answered', 'answered', 'failed']
    assert rows[2]['reason'] == 'its process died'


def fresh(job):
    """A row as a process would make it."""
    return {'bag': job.name, 'status': 'fresh'}


def test_what_waits_is_what_is_new_or_changed(folder, tmp_path):
    def waiting(*axes, effects=True):
        every = fleet.jobs(folder, tmp_path, axes, search_effects=effects)
        return [row['bag'] for row in fleet.run(every, work=fresh) if 'status' in row]

    every = fleet.jobs(folder, tmp_path)
    for job in every[:2]:
        job.row.parent.mkdir(parents=True)
        job.row.write_text(json.dumps({'bag': job.name, 'asked': job.asked}))
    os.utime(tmp_path / 'bags' / 'one' / 'flight' / 'row.json', (0, 0))
    assert waiting() == ['one/flight', 'two/torn']
    # another question has no answer yet
    assert len(waiting('roll')) == len(waiting(effects=False)) == len(every)


def test_lacks_and_outliers_are_found_and_only_where_they_are():
    rng = np.random.default_rng(1)
    rows = [
        {'bag': f'{craft}/{k}', 'aircraft': craft, 'status': 'answered',
         'roll_verdict': 'effects_added', 'roll_effects': effects,
         'roll_lag': 0.04 + 2e-4 * float(rng.standard_normal())}
        for craft, effects in (('a', 'coulomb_friction'), ('b', '')) for k in range(12)
    ]
    rows[-1]['roll_lag'] = 0.06
    shown = [line.split() for line in fleet.lines(rows)]
    assert ['a', 'roll', 'coulomb_friction', '12', '12'] in shown
    assert [words for words in shown if words[-1:] == ['b/11']] == [['roll', 'lag', 'b/11']]
    assert len([words for words in shown if len(words) > 2 and '/' in words[-1]]) == 1
