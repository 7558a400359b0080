"""A fleet's run loses nothing: bad bags and dead workers are rows, a second call does the rest."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from flown_axis import Axis, Plan, fly

from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.fleet import page
from quad_sysid.fleet.row import Job, look
from quad_sysid.fleet.run import Journal, Request, bags, jobs, run, waiting, write_table
from quad_sysid.fleet.summary import summarise

DAY = 86_400 * 10**9


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two aircraft with a flight each, and two things that are no flights."""
    plan = Plan(26.0, (('train', 'prbs', 0.0, 15.0), ('validation', 'prbs', 15.0, 26.0)))
    root = tmp_path_factory.mktemp('fleet')
    for number, (craft, gain) in enumerate((('one', 450.0), ('two', 500.0))):
        record = fly(Axis(gain=gain), number, plan)
        write_bag(replace(record, t0_ns=(20_000 + number) * DAY), root / craft / 'flight')
    (root / 'two' / 'torn').mkdir()
    (root / 'two' / 'torn' / 'torn_0.mcap').write_bytes(b'noise')
    (root / 'notes.txt').write_text('no bag')
    return root


def test_bags_are_found_with_their_aircraft(folder, tmp_path, refusal):
    names = ['one/flight', 'two/flight', 'two/torn']
    assert [str(b.relative_to(folder)) for b in bags(folder)] == names
    assert [job.aircraft for job in jobs(Request(folder, folder / 'out'))] == ['one', 'two', 'two']
    assert 'is not a folder' in refusal(bags, folder / 'nowhere')
    assert 'holds no bag' in refusal(bags, tmp_path)


def test_a_fleet_through_the_command_and_on_from_there(folder, tmp_path, capsys):
    pyarrow = pytest.importorskip('pyarrow.parquet')
    pytest.importorskip('distributed')
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
    table = pyarrow.read_table(out / 'fleet.parquet').to_pylist()
    assert len(table) == 3
    assert {row['bag']: row['roll_gain'] for row in table} == {
        name: row.get('roll_gain') for name, row in rows.items()
    }
    text = (out / 'fleet.html').read_text()
    assert 'roll-fleet' in text
    assert '<script' not in text
    # everything is done: a second call starts nothing and prints the table within 80 columns
    before = (out / 'rows.jsonl').read_text()
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert (out / 'rows.jsonl').read_text() == before
    assert max(len(line) for line in shown.splitlines()[:-1]) <= 80
    assert '2 answered, 1 failed' in shown


def test_a_dead_worker_is_a_row_and_the_rest_go_on(folder, tmp_path):
    pytest.importorskip('distributed')
    import cloudpickle

    def work(job: Job) -> dict:
        if 'torn' in job.name:
            os._exit(1)
        time.sleep(0.2)  # still at work, or its row not fetched yet, when the other one dies
        return {'bag': job.name, 'aircraft': job.aircraft, 'fingerprint': job.fingerprint,
                'status': 'answered', 'reason': '', 'seconds': 0.0}

    by_value = cloudpickle.loads(cloudpickle.dumps(work))
    by_value.__module__ = '__main__'
    rows = run(Request(folder, tmp_path / 'out', workers=1), work=by_value)
    assert [row['status'] for row in rows] == ['answered', 'answered', 'failed']
    assert 'worker died' in rows[2]['reason']


def test_where_no_worker_can_be_started_again_each_bag_is_a_row(folder, tmp_path, monkeypatch):
    pytest.importorskip('distributed')
    from distributed.nanny import WorkerProcess

    begin, begun = WorkerProcess.start, []

    async def only_once(process):
        if begun:
            raise OSError('no more processes')
        begun.append(process)
        return await begin(process)

    monkeypatch.setattr(WorkerProcess, 'start', only_once)
    rows = run(Request(folder, tmp_path / 'out', workers=1), work=lambda _job: os._exit(1))
    assert [row['status'] for row in rows] == 3 * ['failed']
    assert {row['reason'] for row in rows} == {'no worker is left, and none can be started'}


def test_what_waits_is_what_is_new_changed_or_failed(folder, tmp_path):
    every = jobs(Request(folder, tmp_path))
    journal = Journal(tmp_path)
    for job, status in zip(every, ('answered', 'answered', 'failed'), strict=True):
        journal.add({'bag': job.name, 'fingerprint': job.fingerprint, 'status': status})
    journal.add({'bag': 'one/flight', 'fingerprint': 'other', 'status': 'answered'})
    with (tmp_path / 'rows.jsonl').open('a') as stream:
        stream.write('{"bag": "two/fli')  # a kill in the middle of a line
    done = journal.rows()
    assert [job.name for job in waiting(every, done, again=False)] == ['one/flight']
    assert [job.name for job in waiting(every, done, again=True)] == ['one/flight', 'two/torn']
    journal.add({'bag': 'new', 'fingerprint': '', 'status': 'failed'})
    assert set(journal.rows()) == {'one/flight', 'two/flight', 'two/torn', 'new'}


def test_a_fault_of_the_program_is_a_row_too(monkeypatch):
    def broken(_):
        raise RuntimeError('no such thing')

    monkeypatch.setattr('quad_sysid.fleet.row._identified', broken)
    row = look(Job('bag', 'bag', '', ''))
    assert (row['status'], row['reason']) == ('failed', 'RuntimeError: no such thing')


def fleet_rows(slope: float, seed: int) -> list[dict]:
    rng = np.random.default_rng(seed)
    return [
        {
            'bag': f'{craft}/{k}', 'aircraft': craft, 'status': 'answered', 'reason': '',
            'start_ns': (20_000 + k) * DAY, 'roll_verdict': 'effects_added', 'roll_lag_std': 2e-4,
            'roll_effects': effects,
            'roll_lag': 0.04 + drift * k + 2e-4 * float(rng.standard_normal()),
        }
        for craft, effects, drift in (('a', 'coulomb_friction', slope), ('b', '', 0.0))
        for k in range(12)
    ]


def test_drift_lack_and_outliers_are_found_and_only_where_they_are():
    rows = fleet_rows(5e-4, 1)
    rows[-1]['roll_lag'] = 0.06
    found = summarise(rows)
    (drift,), (lack,), (spread,) = found.drifts, found.lacks, found.spreads
    assert (drift.aircraft, drift.axis, drift.parameter) == ('a', 'roll', 'lag')
    assert drift.per_day == pytest.approx(5e-4, rel=0.15)
    told = (lack.aircraft, lack.effect, lack.found, lack.flights)
    assert told == ('a', 'coulomb_friction', 12, 12)
    assert 'b/11' in spread.outliers
    shown = page.page(found, rows, '<all>')
    assert 'dry friction' in shown
    assert '&lt;all&gt;' in shown
    assert [summarise(fleet_rows(0.0, seed)).drifts for seed in range(20)].count(()) >= 19


def test_a_table_without_pyarrow_is_refused_in_one_line(tmp_path, monkeypatch, refusal):
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    assert 'needs the package pyarrow' in refusal(write_table, [], tmp_path / 'x.parquet')
