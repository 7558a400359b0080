"""A fleet loses nothing: bad bags, dead processes, dead workers; a second call does the rest."""

import csv
import io
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from fleet_work import answer, trouble
from flown_axis import Axis, Plan, fly

import quad_sysid as qs
from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.fleets import bag, engine
from quad_sysid.fleets.cli import write
from quad_sysid.fleets.place import Place

MEASURED = ('seconds', 'cpu_s', 'peak_mb', 'kept_bytes', 'source')
PLAN = Plan(26.0, (('train', 'prbs', 0.0, 15.0), ('validation', 'prbs', 15.0, 26.0)))
pytestmark = pytest.mark.xdist_group('fleet')  # one folder for all


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two aircraft with a flight each, and two things that are no flights.

    No gains were recorded, so that none are designed, which would take longest.
    """
    root = tmp_path_factory.mktemp('fleet')
    for number, (craft, gain) in enumerate((('one', 450.0), ('two', 500.0))):
        flight = replace(fly(Axis(gain=gain), number, PLAN), gains=())
        write_bag(flight, root / craft / 'flight')
    (root / 'two' / 'torn').mkdir()
    (root / 'two' / 'torn' / 'torn_0.mcap').write_bytes(b'noise')
    (root / 'notes.txt').write_text('no bag')
    return root


def same(rows):
    return [{key: value for key, value in row.items() if key not in MEASURED} for row in rows]


def test_bags_and_logs_are_found_with_their_aircraft(folder, tmp_path, refusal):
    found = [(job.name, job.aircraft) for job in bag.jobs(folder, tmp_path)]
    assert found == [('one/flight', 'one'), ('two/flight', 'two'), ('two/torn', 'two')]
    (tmp_path / 'linked' / 'three').mkdir(parents=True)
    (tmp_path / 'linked' / 'three' / 'flight').symlink_to(folder / 'one' / 'flight')
    (tmp_path / 'linked' / 'three' / 'back').symlink_to(tmp_path)
    assert [job.name for job in bag.jobs(tmp_path / 'linked', 'o')] == ['three/flight']
    (tmp_path / 'logs').mkdir()
    for name in ('b.ULG', 'a.bbl.gz', 'c.csv'):
        (tmp_path / 'logs' / name).write_text('a log')
    assert [job.name for job in bag.jobs(tmp_path / 'logs', tmp_path / 'o')] == [
        'a.bbl.gz', 'b.ULG']
    assert 'is not a folder' in refusal(bag.jobs, folder / 'nowhere', tmp_path)
    shutil.rmtree(tmp_path / 'logs')
    assert 'holds no bag' in refusal(bag.jobs, tmp_path, tmp_path)


def test_a_name_that_is_no_utf_8_stops_no_fleet(tmp_path, refused, monkeypatch):
    monkeypatch.setattr(engine, '_by_threads', lambda todo, *_: (
        bag.keep(job, bag.look(job)) for job in todo))
    root, out = tmp_path / os.fsdecode(b'fl\xe9'), tmp_path / 'out'
    long = 60 * b'\xe9' + b'/torn_0.mcap'  # escaped it is longer than a disk takes
    for name in ('one/torn_0.mcap', os.fsdecode(b'vol_\xe9/torn_0.mcap'), os.fsdecode(long)):
        (root / name).parent.mkdir(parents=True)
        (root / name).write_bytes(b'noise')
    for options in ((), ('--shard', '1/1'), ('--merge',)):
        error = refused(main, 'fleet', root, '--out', out, *options, status=3)
        assert r'fl\udce9: no bag could be answered' in error
    with (out / 'fleet.csv').open() as stream:
        rows = {row['bag']: row for row in csv.DictReader(stream)}
    assert rows.keys() == {'one/torn_0.mcap', r'vol_\udce9/torn_0.mcap',
                           60 * r'\udce9' + '/torn_0.mcap'}
    assert rows[r'vol_\udce9/torn_0.mcap']['aircraft'] == r'vol_\udce9'
    assert all('is neither mcap nor sqlite3' in row['reason'] for row in rows.values())
    assert r'vol_\udce9/torn_0.mcap failed' in (out / 'fleet.log').read_text()


@pytest.fixture(scope='module')
def results(folder, tmp_path_factory):
    """Of the command, and what it printed."""
    out = tmp_path_factory.mktemp('results') / 'out'
    assert main(['fleet', str(folder), '--out', str(out), '--no-effects', '--workers', '2',
                 '--quiet']) == 0
    return out


def test_a_fleet_through_the_command_and_on_from_there(
    folder, results, tmp_path, printed, refused
):
    arguments = ['fleet', str(folder), '--out', str(results), '--no-effects']
    before = {path: path.stat().st_mtime_ns for path in results.rglob('*flight.json')}
    rows = {row['bag']: row for row in json.loads(printed(main, *arguments, '--json'))}
    assert [rows[b]['status'] for b in ('one/flight', 'two/flight', 'two/torn')] == [
        'answered', 'answered', 'failed'
    ]
    # the true gains are 450 and 500; 20 s of training tell them within some per cent
    assert rows['one/flight']['roll_gain'] == pytest.approx(450.0, rel=0.04)
    assert rows['two/flight']['roll_gain'] == pytest.approx(500.0, rel=0.04)
    assert 'neither mcap nor sqlite3' in rows['two/torn']['reason']
    with (results / 'fleet.csv').open() as stream:
        told = {row['bag']: row['roll_gain'] for row in csv.DictReader(stream)}
    assert told == {name: str(row.get('roll_gain', '')) for name, row in rows.items()}
    assert (results / 'bags' / 'two' / 'flight' / 'report.json').exists()
    assert '<h2>Without an answer</h2>' in (results / 'fleet.html').read_text()
    # this second call tried the failed bag alone; the log says so, and what it all costs
    assert len(before) == 2
    assert before == {path: path.stat().st_mtime_ns for path in results.rglob('*flight.json')}
    log = (results / 'fleet.log').read_text()
    assert '3 bags, 3 to do' in log
    assert '3 bags, 1 to do' in log
    assert 's of CPU each' in log
    # bags and results are known wherever they are moved, and by no other flights
    moved = tmp_path / 'elsewhere'
    shutil.copytree(folder, moved, copy_function=shutil.copyfile)
    shutil.copytree(results, tmp_path / 'out')
    again = ['fleet', str(moved), '--out', str(tmp_path / 'out'), '--no-effects']
    shown = printed(main, *again)
    assert '2 answered, 1 failed' in shown
    assert 'without an answer: two/torn; the table has the reasons' in shown
    assert max(len(line) for line in shown.splitlines()[:-1]) <= 80
    assert '3 bags, 1 to do' in (tmp_path / 'out' / 'fleet.log').read_text().splitlines()[-3]
    shutil.rmtree(moved / 'one')
    shutil.copytree(moved / 'two' / 'flight', moved / 'one' / 'flight')
    assert 'holds the results of another bag' in refused(main, *again)


def test_a_cluster_gives_the_same_rows_and_outlives_what_goes_wrong(folder, results, tmp_path):
    distributed = pytest.importorskip('distributed')
    import dask

    flights = tmp_path / 'flights'
    shutil.copytree(folder, flights)
    shutil.rmtree(flights / 'two' / 'flight')
    for name in ('poison', 'hung', 'unlucky', *'abcdef'):
        (flights / f'{name}.mcap').touch()
    jobs = bag.jobs(flights, tmp_path / 'out', search_effects=False)
    every = [bag.replace(job, limit_s=1.0) if job.name == 'hung.mcap' else job for job in jobs]
    told = []
    with dask.config.set(engine.SETTINGS), distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=':0', memory_limit=0,
            silence_logs='CRITICAL') as cluster:
        rows = engine.run(every, cluster=cluster.scheduler_address, work=trouble, log=told.append)
    by_name = {row['bag']: row for row in rows}
    assert by_name['poison.mcap']['reason'] == 'its process died (status 7), 2 times'
    assert by_name['hung.mcap']['reason'] == 'took longer than 1 s'
    assert (tmp_path / 'out' / 'once').exists()  # a worker was killed, and its bag was done
    failed = [row['bag'] for row in rows if row['status'] == 'failed']
    assert failed == ['hung.mcap', 'poison.mcap']
    assert len(told) == 1 + len(every) + 1
    # what is done is done: on this machine the rest is tried again, and nothing else
    kept = engine.known(every)
    assert len(kept) == len(every)
    once_more = engine.run(jobs, 2, work=answer)
    assert [row['bag'] for row in once_more if row['bag'] in failed] == failed
    assert all(row['status'] == 'answered' for row in once_more)
    # to the last digit what the processes of this machine say
    own = engine.known(bag.jobs(folder, results, search_effects=False))
    assert same([by_name['one/flight']]) == same([own['one/flight']])


def test_a_cluster_that_differs_is_refused_before_the_first_bag(folder, tmp_path, monkeypatch,
                                                               refusal):
    class Client:
        def wait_for_workers(self, *_, **__):
            pass

        def run(self, *_, **__):
            return {'tcp://there:1': {**engine.about_here(job, ''), 'numpy': '1.0'}}

    job = bag.jobs(folder, tmp_path)[0]
    assert 'tcp://there:1: its numpy is not as here: found 1.0' in refusal(
        engine._compare, Client(), job)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(engine, 'TIMEOUT_S', 0.2)
    assert 'cannot be reached' in refusal(
        engine.run, [job], cluster='tcp://127.0.0.1:1')


def test_shards_are_all_of_it_and_meet_in_one_table(tmp_path, refusal, printed):
    craft = ('007', 'ä=b', '', '12')
    for number in range(40):
        (tmp_path / 'flights' / craft[number % 4]).mkdir(parents=True, exist_ok=True)
        (tmp_path / 'flights' / craft[number % 4] / f'{number}.mcap').touch()
    every = bag.jobs(tmp_path / 'flights', tmp_path / 'out')
    shards = [engine.shard_of(every, f'{i}/3') for i in (1, 2, 3)]
    assert sorted(job.name for shard in shards for job in shard) == [job.name for job in every]
    assert 'must be i/n' in refusal(engine.shard_of, every, '4/3')
    for shard in shards[:2]:
        engine.run(shard, work=answer)
    merge = ['fleet', str(tmp_path / 'flights'), '--out', str(tmp_path / 'out'), '--merge']
    assert f'{len(shards[2])} bags are not done yet' in printed(main, *merge)
    with (tmp_path / 'out' / 'fleet.csv').open() as stream:
        rows = sorted((row['bag'], row['aircraft'], row['status'])
                      for row in csv.DictReader(stream))
    assert len(rows) == len(shards[0]) + len(shards[1])
    assert {row[1] for row in rows} == {*craft}
    folder, columns = tmp_path / 'out' / 'fleet.parquet', ['bag', 'aircraft', 'status']
    dataset = pytest.importorskip('pyarrow.dataset')
    table = dataset.dataset(folder, partitioning='hive').to_table()
    assert sorted(zip(*(table[name].to_pylist() for name in columns), strict=True)) == rows


def test_another_question_has_no_answer_yet(folder, tmp_path):
    def done(*axes, **more):
        every = bag.jobs(folder, tmp_path, axes=axes, **more)
        return sum(engine._done(job, engine.known(every).get(job.name)) for job in every)

    assert done() == 0
    engine.run(bag.jobs(folder, tmp_path), work=answer)
    assert (done(), done('roll'), done(search_effects=False), done(effects='x')) == (3, 0, 0, 0)


def test_bags_and_results_of_a_store(folder, results):
    """In memory, which is one process' own; the work is done here."""
    fsspec = pytest.importorskip('fsspec')
    store = fsspec.filesystem('memory')
    store.put(str(folder), '/bucket/flights', recursive=True)
    try:
        every = bag.jobs('memory://bucket/flights', 'memory://bucket/out', search_effects=False)
        here = bag.jobs(folder, f'file://{results}', search_effects=False)
        assert [job.name for job in every] == [job.name for job in here]
        row = bag.keep(every[0], bag.look(every[0]))
        own = engine.known(here)[row['bag']]
        assert {**row, 'stamp': own['stamp']}.items() >= {
            key: value for key, value in own.items() if key not in MEASURED}.items()
        assert engine.run(every[:1]) == [row]  # it is done
        write([row], Place('memory://bucket/out'))
        table = list(csv.DictReader(io.StringIO(store.cat('/bucket/out/fleet.csv').decode())))
        assert [row['bag'] for row in table] == ['one/flight']
        assert store.exists('/bucket/out/bags/one/flight/model.json')
    finally:
        store.rm('/bucket', recursive=True)


@pytest.mark.others
@pytest.mark.parametrize('reader', ['pandas', 'duckdb', 'polars'])
def test_the_rows_of_all_aircraft_are_one_table_to(reader, tmp_path):
    library = pytest.importorskip(reader)
    rows = [{'bag': f'{craft}/{i}', 'aircraft': craft, 'status': 'failed'}
            | ({'roll_gain': 450.0 + i, 'start_ns': 10**18 + i} if craft != 'ä=b' else {})
            for craft in ('007', 'ä=b', '', '12', '-') for i in range(2)]
    write(rows, Place(tmp_path))
    folder, columns = tmp_path / 'fleet.parquet', ['bag', 'aircraft', 'roll_gain']
    if reader == 'pandas':
        table = library.read_parquet(folder)[columns]
        found = table.astype(object).where(table.notna(), None).to_numpy().tolist()
    elif reader == 'duckdb':
        found = library.read_parquet(f'{folder}/*/*.parquet').select(*columns).fetchall()
    else:
        found = library.read_parquet(f'{folder}/**/*.parquet')[columns].rows()
    assert sorted(map(tuple, found)) == sorted(
        (row['bag'], row['aircraft'], row.get('roll_gain')) for row in rows)


@pytest.mark.others
def test_an_s3_server_holds_bags_and_results(folder, monkeypatch):
    """That of moto; where it and s3fs are installed, which no other test needs."""
    pytest.importorskip('s3fs')
    server = pytest.importorskip('moto.server').ThreadedMotoServer(port=0)
    server.start()
    for name, value in {'FSSPEC_S3_ENDPOINT_URL': 'http://{}:{}'.format(*server.get_host_and_port()),
                        'FSSPEC_S3_KEY': 'key', 'FSSPEC_S3_SECRET': 'secret'}.items():
        monkeypatch.setenv(name, value)
    import fsspec.config

    try:
        fsspec.config.set_conf_env(fsspec.config.conf)
        store = fsspec.filesystem('s3')
        store.mkdir('bucket')
        store.put(str(folder), 's3://bucket/flights', recursive=True)
        arguments = ['fleet', 's3://bucket/flights', '--out', 's3://bucket/out', '--no-effects',
                     '--workers', '2', '--quiet']
        command = 'import sys; from quad_sysid.start import main; sys.exit(main())'
        for _ in range(2):  # processes of their own, which begin with this environment
            subprocess.run([sys.executable, '-c', command, *arguments], cwd=folder, check=True)
        assert '3 bags, 1 to do' in (folder / 'flights_fleet.log').read_text()  # where it began
        row = json.loads(store.cat('s3://bucket/out/rows/one/flight.json'))
        assert row['roll_gain'] == pytest.approx(450.0, rel=0.04)
        table = csv.DictReader(io.StringIO(store.cat('s3://bucket/out/fleet.csv').decode()))
        assert [row['status'] for row in table] == ['answered', 'answered', 'failed']
        assert store.exists('s3://bucket/out/fleet.html')
    finally:
        server.stop()


def test_records_are_a_fleet_too(refusal):
    records = [fly(Axis(), 1, Plan(6.0, (('train', 'prbs', 0.0, 6.0),)))]
    fleet = qs.fleet(records, aircraft=['a'], search_effects=False)
    assert [(row['bag'], row['aircraft'], row['status']) for row in fleet.rows] == [
        ('a/flight 1', 'a', 'cannot_tell')]
    assert (fleet.drifts, fleet.odd) == ([], {})
    assert 'one for each' in refusal(qs.fleet, records, aircraft=['a', 'b'])
    assert 'neither a day' in refusal(qs.fleet, records, since='yesterday')
