"""The app where something goes wrong: each message is one line, and nothing is lost."""

import importlib.util
import json
import signal
import sys
import time
from pathlib import Path

import pytest
from probe import PATIENCE_S

from quad_sysid.cli import main

pytest.importorskip('starlette', reason="the extra is not installed: pip install '…[app]'")
_SPEC = importlib.util.spec_from_file_location('test_app', Path(__file__).with_name('test_app.py'))
APP = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(APP)
browser = APP.browser


@pytest.fixture
def started():
    """Servers on folders; all end with the test."""
    servers = []

    def start(folder):
        servers.append(APP.Server(folder))
        return servers[-1]

    yield start
    for server in servers:
        server.process.send_signal(signal.SIGINT)
        assert server.process.wait(PATIENCE_S) in (0, 130)


def test_a_name_of_any_letters_fits_the_disk_and_a_bags_metadata_says_what_to_drop(tmp_path):
    from quad_sysid.app.folder import RefusedError, new_file

    for name in ('飛' * 119 + '.csv', '飛' * 119 + '.csv', 'a' * 5000 + '.ulg'):
        made = new_file(tmp_path, name)
        assert made.suffix == name[-4:]
        assert made.stat().st_size == 0
    with pytest.raises(RefusedError, match=r'\.mcap files alone'):
        new_file(tmp_path, 'my_flight/metadata.yaml')


def test_bags_of_logs_get_names_of_their_own_and_one_file_is_one(tmp_path):
    from quad_sysid.app.commands import commands
    from quad_sysid.app.folder import RefusedError

    for name in ('a.ulg', 'a.bin'):
        (tmp_path / name).write_bytes(b'ULog\x01\x12\x35')
    (tmp_path / 'a.csv').write_text('t,p\n0,1\n')
    *imports, _ = commands(tmp_path, {'kind': 'identify', 'files': ['a.ulg', 'a.bin']})
    bags = {one[2][-1] for one in imports}
    assert len(bags) == 2
    (again,) = commands(tmp_path, {'kind': 'import', 'files': ['a.ulg']}, bags)
    assert again[2][-1] not in bags
    for asked, words in (({'kind': 'inspect', 'files': ['a.ulg', 'a.bin']}, 'choose one'),
                         ({'kind': 'import', 'files': ['a.csv']}, 'a.csv is a table.*Columns')):
        with pytest.raises(RefusedError, match=words):
            commands(tmp_path, asked)


def test_without_its_bag_an_identification_says_why_and_the_next_start_shows_all(tmp_path):
    from quad_sysid.app.jobs import KEPT, Queue

    (tmp_path / 'log.bin').write_bytes(b'\xa3\x95')
    queue = Queue(tmp_path / 'results')
    made = queue.add('import log.bin', 'quad-sysid', ['import', str(tmp_path / 'log.bin')])
    after = queue.add('identify', 'quad-sysid', ['identify', str(tmp_path / 'bag')], after=[made])
    end = time.monotonic() + PATIENCE_S
    while not after.ended and time.monotonic() < end:
        time.sleep(0.05)
    queue.close()
    assert made.state == after.state == 'failed'
    assert 'log.bin' in made.doing
    assert after.doing == f'import log.bin: {made.doing}'
    assert after.text().splitlines() == [after.doing]
    note = after.folder / KEPT
    note.write_text(note.read_text().replace('"failed"', '"running"'))  # as a kill leaves it
    (made.folder.parent / 'other').mkdir()
    (made.folder.parent / 'other' / KEPT).write_text('{}')
    later, earlier = Queue(tmp_path / 'results').all()
    assert (earlier.title, earlier.state, earlier.text()) == (made.title, 'failed', made.text())
    assert (later.state, later.doing) == ('stopped', 'the app ended first: start it again')


def test_a_folder_that_is_gone_is_one_line(started, tmp_path):
    folder = tmp_path / 'flights'
    folder.mkdir()
    server = started(folder)
    folder.rmdir()
    status, text = server.ask('/upload?name=a.csv', b't\n')
    assert status == 400
    assert json.loads(text)['error'].startswith('a.csv: No such file or directory; check')
    status, text = server.ask('/upload?name=a.exe', b't\n')
    assert json.loads(text)['error'].startswith('a.exe: no log by its name')


def test_an_error_stands_on_a_line_of_its_own_after_progress(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True)
    assert main(['look', 'nothing_here']) == 2
    assert capsys.readouterr().err.startswith('\r\x1b[2Kquad-sysid: nothing_here: ')


@pytest.mark.browser
def test_what_is_dropped_is_named_and_a_server_that_has_ended_too(
        started, browser, tmp_path, plain_bag):
    (tmp_path / 'flights').mkdir()
    server = started(tmp_path / 'flights')
    for name, content in (('a.csv', 't\n'), ('notes.doc', 'x'), ('big.bin', 'x' * 1_100_000)):
        (tmp_path / name).write_text(content)
    browser.send('Page.navigate', url=server.address)
    browser.until("document.getElementById('files')?.innerText.includes('no logs here yet')")
    said = "document.getElementById('say').innerText"

    def drop(*paths):
        data = {'items': [], 'files': [str(path) for path in paths], 'dragOperationsMask': 1}
        for kind in ('dragEnter', 'dragOver', 'drop'):
            browser.send('Input.dispatchDragEvent', type=kind, x=200, y=200, data=data)

    drop(*(tmp_path / name for name in ('notes.doc', 'a.csv', 'big.bin')))
    browser.until(f"{said}.includes('big.bin: larger than 1 MB')")
    assert browser.run(f"{said}.includes('notes.doc: no log by its name')")
    assert browser.run(f"{said}.includes('a.csv is there')")
    drop(tmp_path / 'a.csv')
    browser.until(f"{said}.includes('a.csv is there as a_2.csv')")
    drop(plain_bag)  # a folder
    browser.until(f"{said}.includes('.mcap')")
    server.process.send_signal(signal.SIGINT)
    server.process.wait(PATIENCE_S)
    browser.until(f"{said}.includes('start quad-sysid app again')")
    browser.errors.clear()  # that the connection was refused
