"""Recorders killed or cut off: nothing lost beyond the bound (the study: bench/log_kills.py)."""

import json
import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from probe import PATIENCE_S

from quad_bridge.bag_writer import BagWriter
from quad_bridge.damaged_mcap import DamagedMcap
from quad_bridge.damaged_sqlite import DamagedSqlite
from quad_bridge.recover import recover
from quad_sysid.bags.storage import Storage

STUDY = Path(__file__).resolve().parents[2] / 'bench' / 'log_kills.py'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
TOPIC = '/setpoint/rates'
FILL = b'\x55' * 150


@pytest.mark.long
def test_thirty_recorders_lose_at_most_a_second(tmp_path):
    done = subprocess.run(
        [sys.executable, str(STUDY), '--points', '30', '--parallel', '10', '--seed', '7'],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told['points'] == 30
    assert told['beyond_bound'] == 0, done.stdout
    assert told['strange_messages'] == 0
    assert told['unrecovered_short'] == 0  # readers need no recovery first


def written(path, storage, n=3000, flush=100):
    writer = BagWriter(path, storage)
    writer.add_topic(TOPIC, VECTOR)
    for k in range(n):
        writer.write(TOPIC, 10**18 + k, k.to_bytes(8, 'little') + FILL)
        if k % flush == flush - 1:
            writer.flush()
    return writer


def numbers(messages):
    found = list(messages)
    assert {m.data[8:] for m in found} <= {FILL}  # no message with another content
    return [int.from_bytes(m.data[:8], 'little') for m in found]


def test_a_transaction_that_was_not_finished_is_undone_on_a_copy(tmp_path):
    writer = written(tmp_path / 'bag', 'sqlite3', 500)
    base = writer._file._base
    base.execute('PRAGMA cache_size=5')  # so that the file itself is changed before the commit
    base.executemany(
        'INSERT INTO messages VALUES(NULL, 1, ?, ?)', [(k, bytes(300)) for k in range(3000)]
    )
    killed = tmp_path / 'killed'
    killed.mkdir()
    for file in (tmp_path / 'bag').iterdir():
        (killed / file.name).write_bytes(file.read_bytes())
    before = {p.name: p.read_bytes() for p in killed.iterdir()}
    assert any(name.endswith('-journal') for name in before)
    result = recover(killed)
    assert result.messages == 500
    assert 'last transaction was not finished' in '\n'.join(result.notes)
    assert {p.name: p.read_bytes() for p in killed.iterdir()} == before


def test_a_torn_page_is_never_filled_up_with_zeros(tmp_path):
    rng = np.random.default_rng(8)
    rows = {k: rng.integers(1, 256, 150, dtype=np.uint8).tobytes() for k in range(1500)}
    writer = BagWriter(tmp_path / 'bag', 'sqlite3')
    writer.add_topic(TOPIC, VECTOR)
    for k, data in rows.items():
        writer.write(TOPIC, 10**18 + k, data)
    writer.flush()
    synced = writer._file.path.stat().st_size
    base = writer._file._base
    base.execute('PRAGMA cache_size=5')
    base.executemany(
        'INSERT INTO messages VALUES(NULL, 1, ?, ?)', [(k, b'\7' * 300) for k in range(1000)]
    )
    for i, cut in enumerate(rng.integers(synced // 4, synced, 8)):
        killed = tmp_path / f'killed{i}'
        killed.mkdir()
        for file in (tmp_path / 'bag').iterdir():
            (killed / file.name).write_bytes(file.read_bytes())
        os.truncate(killed / 'bag_0.db3', int(cut))
        whole = set(rows.values())
        found = [m.data for m in DamagedSqlite(killed / 'bag_0.db3').messages()]
        read = [raw for batch in Storage(killed, (TOPIC,)).batches() for raw in batch[TOPIC]]
        assert set(found) <= whole
        assert len(found) == len(set(found)) > 100
        assert set(read) <= set(found)


def test_a_database_cut_off_anywhere_gives_the_rows_before_the_cut(tmp_path):
    writer = written(tmp_path / 'bag', 'sqlite3')
    data = writer._file.path.read_bytes()
    writer.abort()
    rng = np.random.default_rng(4)
    cut_file = tmp_path / 'cut.db3'
    # within the last page too: SQLite would take that for whole
    for cut in (*rng.integers(len(data) // 10, len(data), 25), len(data) - 1500, len(data) - 1):
        cut_file.write_bytes(data[:cut])
        got = numbers(DamagedSqlite(cut_file).messages())
        assert got == sorted(set(got))
        # rows fill the file evenly; some pages for the index and what SQLite moves as it grows
        assert set(range(int(3000 * (cut - 40_000) / len(data)))) <= set(got)


def test_pages_are_read_without_their_tree_also_long_rows(tmp_path):
    path = tmp_path / 'bag.db3'
    base = sqlite3.connect(path)
    base.execute(
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,'
        ' timestamp INTEGER NOT NULL, data BLOB NOT NULL)'
    )
    base.execute('CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, format,'
                 ' offered_qos_profiles, hash)')  # fmt: skip
    base.execute("INSERT INTO topics VALUES(1, '/t', 'a/msg/B', 'cdr', '', '')")
    rng = np.random.default_rng(5)
    rows = [(1, int(t), rng.bytes(int(size)))
            for t, size in zip(rng.integers(-5, 2**40, 60), rng.integers(0, 30_000, 60),
                               strict=True)]  # fmt: skip
    base.executemany('INSERT INTO messages VALUES(NULL, ?, ?, ?)', rows)
    base.commit()
    base.close()
    whole = path.read_bytes()
    assert [(m.time_ns, m.data) for m in DamagedSqlite(path).messages()] == [r[1:] for r in rows]
    path.write_bytes(whole[:-1])  # SQLite refuses it now: the header counts a page more
    torn = DamagedSqlite(path)
    got = [(m.time_ns, m.data) for m in torn.messages()]
    assert not torn.complete
    assert len(got) >= 58
    assert set(got) <= {r[1:] for r in rows}


def test_noise_in_a_database_never_raises(tmp_path):
    writer = written(tmp_path / 'bag', 'sqlite3', 300)
    data = writer._file.path.read_bytes()
    writer.abort()
    rng = np.random.default_rng(6)
    spoiled = tmp_path / 'spoiled.db3'
    found = []
    for _ in range(40):
        noisy = bytearray(data)
        for place in rng.integers(100, len(data), 30):
            noisy[place] = rng.integers(256)
        spoiled.write_bytes(bytes(noisy))
        found.append(len(list(DamagedSqlite(spoiled).messages())))
    assert np.median(found) > 200


@pytest.mark.parametrize('where', ['length', 'content', 'zeros'])
def test_behind_a_damaged_chunk_the_next_one_is_found(tmp_path, where):
    writer = written(tmp_path / 'bag', 'mcap', 1000)
    data = bytearray(writer._file.path.read_bytes())
    writer.abort()
    chunk = data.find(b'\x06', data.find((350).to_bytes(8, 'little') + FILL))
    # the chunk of 400 to 499: from its record's opcode on
    while int.from_bytes(data[chunk + 9 : chunk + 17], 'little') != 10**18 + 400:
        chunk = data.find(b'\x06', chunk + 1)
    if where == 'length':
        data[chunk + 5] = 0xFF
    elif where == 'content':
        data[chunk + 3000] ^= 0x40
    else:
        data[chunk : chunk + 200] = bytes(200)
    path = tmp_path / 'spoiled.mcap'
    path.write_bytes(bytes(data))
    damaged = DamagedMcap(path)
    got = numbers(damaged.messages())
    assert got == sorted(got)
    # a wrong length costs nothing: the chunk's own lengths and checksum hold
    lost = [] if where == 'length' else list(range(400, 500))
    assert sorted(set(range(1000)) - set(got)) == lost
    assert damaged.bad_chunks == (where == 'content')


def test_what_was_lost_is_said_with_its_time(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic(TOPIC, VECTOR)
    for k in (0, 1, 2, 60, 61):
        writer.write(TOPIC, 10**18 + k * 100_000_000, bytes(40))
    writer.flush()
    writer.abort()
    lines = '\n'.join(recover(tmp_path / 'bag').lines())
    assert '5 messages over 6.10 s recovered' in lines
    assert 'nothing for 5.80 s at 0.20 s' in lines
    assert 'ends without its index' in lines
