"""The app: who is answered, what can be asked, what goes wrong; app and report in a browser."""

import asyncio
import contextlib
import dataclasses
import importlib
import json
import os
import re
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from flown_axis import model_of
from flown_craft import DT, Airframe, X, fly
from node_process import until
from probe import PATIENCE_S

from quad_sysid.app.commands import commands, named_columns
from quad_sysid.app.folder import RefusedError, entries, new_file, receive
from quad_sysid.app.jobs import JOB_FILE, MOST_WAITING, Job, Queue, expected, follow
from quad_sysid.cli import main
from quad_sysid.contract import MIXER_INVERSE
from quad_sysid.files import UNFINISHED
from quad_sysid.loop.cascade import CascadeGains, margins, open_loop
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.linear import WIDE, loops_of
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.report import sliders
from quad_sysid.report.style import script

pytest.importorskip('starlette', reason="the extra is not installed: pip install '…[app]'")
uvicorn = pytest.importorskip(
    'uvicorn', reason="the extra is not installed: pip install '…[app]'")
App = importlib.import_module('quad_sysid.app.server').App
BROWSER = next((name for name in ('chromium', 'chromium-browser', 'google-chrome')
                if shutil.which(name)), '')
MOST_MB = 1
ANSWER_S = 60.0
"""A browser that has not answered until then never does: a page of ours never blocks it."""


class Client:
    def __init__(self, folder: Path, address: str) -> None:
        self.folder, self.address = folder, address
        self.base, _, self.token = address.partition('/?token=')
        self.port = self.base.rpartition(':')[2]

    def ask(self, path, data=None, *, token=True, **headers):
        """(status, text) of a request."""
        sent = {name.replace('_', '-'): value for name, value in headers.items()}
        if token:
            sent['Cookie'] = f'quad_sysid_token_{self.port}={self.token}'
        request = urllib.request.Request(self.base + path, data, sent)  # noqa: S310
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:  # noqa: S310
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def names(self):
        return {path.name for path in self.folder.iterdir()}

    def job(self, **asked):
        return self.ask('/jobs', json.dumps(asked).encode())


@pytest.fixture(scope='module')
def server(tmp_path_factory, plain_bag):
    folder = tmp_path_factory.mktemp('app') / 'flights'
    shutil.copytree(plain_bag, folder / 'my_flight')
    (folder.parent / 'secret.csv').write_text('a,b\n')
    (folder / 'link.csv').symlink_to(folder.parent / 'secret.csv')
    app, line = App(folder, MOST_MB), socket.create_server(('127.0.0.1', 0))
    running = uvicorn.Server(uvicorn.Config(app.starlette(), log_level='warning'))
    thread = threading.Thread(target=running.run, args=([line],))
    thread.start()
    yield Client(folder, f'http://127.0.0.1:{line.getsockname()[1]}/?token={app.token}')
    running.should_exit = True
    thread.join()


@pytest.fixture
def started(run):
    """A function that starts the app on a folder as a process."""

    def start(folder):
        process = run(sys.executable, '-c', 'from quad_sysid.start import main; main()', 'app',
                      folder, '--no-browser', '--most-mb', MOST_MB)
        process.until(lambda: '\n' in process.printed)
        return process, Client(folder, process.printed.splitlines()[0])

    return start


def test_only_who_has_the_token_on_this_machine_is_answered(server):
    assert server.ask('/files', token=False)[0] == 403
    assert server.ask('/files')[0] == 200
    for wrong in ({'Host': 'example.org'}, {'Origin': 'http://example.org'},
                  {'Origin': 'null'}):
        assert server.ask('/files', **wrong)[0] == 403, wrong
    assert server.ask('/jobs', b'{}', Sec_Fetch_Site='cross-site')[0] == 403
    assert server.ask('/?token=wrong', token=False)[0] == 403


def test_no_name_leads_out_of_the_folder(server):
    listed = {entry['path'] for entry in json.loads(server.ask('/files')[1])}
    assert 'my_flight' in listed
    assert 'link.csv' not in listed
    for name in ('../secret.csv', 'link.csv', '/etc/passwd', '.', '', 'my_flight/../../secret.csv',
                 'nothing', 'a\0b'):
        status, text = server.job(kind='look', files=[name])
        assert status == 400, name
        assert 'file' in text
    for asked in ({'kind': 'rm'}, {'kind': 'identify', 'axis': '--help'},
                  {'kind': 'identify', 'train': '1:2 --out /'}, {'kind': 'compare'},
                  {'kind': 'export', 'to': 'px4'}, {'kind': 'schedule'},
                  {'kind': 'import', 'columns': [['p', '--out', '']]},
                  {'kind': 'import', 'columns': [['p', 'rate, roll', 'rad/s --out /']]},
                  {'kind': 'import', 'columns': [['\0t', 'time', ''], ['u', 'control, roll', ''],
                                                 ['p', 'rate, roll', '']]},
                  {'kind': 'import', 'columns': [['t', 'time', '']]}):
        assert server.job(files=['my_flight'], **asked)[0] == 400, asked
    assert server.ask('/jobs', b'[]')[0] == 400
    assert server.ask('/jobs/1/%2e%2e/%2e%2e/secret.csv')[0] in (400, 404)


def test_what_is_dropped_gets_a_safe_name_and_a_limit(server):
    before = server.names()
    status, text = server.ask('/upload?name=..%2F..%2F%3Cimg%20src%3Dx%3E%22.csv', b't,a\n')
    assert status == 200
    assert json.loads(text)['path'] == '_img src_x__.csv'
    assert json.loads(server.ask('/upload?name=_img%20src_x__.csv', b't\n')[1])['path'] == (
        '_img src_x___2.csv')
    for written in ('model.json', 'model_2.json'):
        _, text = server.ask('/upload?name=model.json', b'{"schema": "quad_sysid/model/3"}')
        assert json.loads(text)['path'] == written
        assert {'path': written, 'kind': 'model'}.items() <= next(
            entry for entry in json.loads(server.ask('/files')[1]) if entry['path'] == written
        ).items()
    assert server.ask('/upload?name=report.json', b'{"schema": "quad_sysid/report/3"}')[0] == 400
    assert server.ask('/upload?name=evil.sh', b'x')[0] == 400
    assert server.ask('/upload?name=empty.csv', b'')[0] == 400
    try:
        status = server.ask('/upload?name=large.bin', bytes(MOST_MB * 1_000_000 + 1))[0]
    except urllib.error.URLError:  # it hangs up before all is sent
        status = 400
    assert status == 400
    assert server.names() - before == {'_img src_x__.csv', '_img src_x___2.csv', 'model.json',
                                       'model_2.json'}
    for name in server.names() - before:
        (server.folder / name).unlink()


def test_what_cannot_be_read_is_neither_opened_nor_hides_the_rest(tmp_path, monkeypatch):
    for name in ('flight.csv', 'gone.csv'):
        (tmp_path / name).write_text('t\n')
    for name in ('pipe', 'pipe.csv', 'pipe.json'):
        os.mkfifo(tmp_path / name)
    (tmp_path / 'lost+found').mkdir()
    stat = Path.stat

    def watched(path, **options):  # the tests may run as root, who may open any folder
        if path.parent.name == 'lost+found':
            raise PermissionError(13, 'Permission denied')
        if path.name == 'gone.csv':
            raise FileNotFoundError(2, 'No such file or directory')
        return stat(path, **options)

    monkeypatch.setattr(Path, 'stat', watched)
    found = []
    thread = threading.Thread(target=lambda: found.extend(entries(tmp_path)), daemon=True)
    thread.start()
    thread.join(2.0)
    assert [entry.path for entry in found] == ['flight.csv']
    with pytest.raises(RefusedError, match='no such file'):
        commands(tmp_path, {'kind': 'import', 'files': ['pipe.csv']})


def test_a_name_that_is_no_utf_8_is_listed_and_can_be_chosen(server):
    name = os.fsdecode(b'vol_\xe9.csv')
    (server.folder / name).write_text('t\n')
    status, text = server.ask('/files')
    assert (status, name in [entry['path'] for entry in json.loads(text)]) == (200, True)
    status, text = server.job(kind='look', files=[name])
    job = json.loads(text)
    assert (status, job['title']) == (200, r'look at vol_\udce9.csv')
    assert server.ask(f'/jobs/{job["number"]}/stop', b'')[0] == 200
    assert server.ask('/jobs')[0] == 200
    (server.folder / name).unlink()


def test_an_upload_is_listed_when_it_is_whole_and_none_is_left_cut_off(server):
    before = server.names()
    host, port = server.base.removeprefix('http://').split(':')
    with socket.create_connection((host, int(port)), PATIENCE_S) as line:
        line.sendall(f'POST /upload?name=slow.csv HTTP/1.1\r\nHost: {host}:{port}\r\nCookie: '
                     f'quad_sysid_token_{port}={server.token}\r\nContent-Length: 99\r\n\r\nt,a\n'
                     .encode())
        until(lambda: server.names() - before)
        assert all(name.startswith(UNFINISHED) for name in server.names() - before)
        assert 'slow.csv' not in server.ask('/files')[1]
    until(lambda: server.names() == before)


def test_a_body_of_200_mb_is_refused_without_being_held(tmp_path):
    part = bytes(4_000_000)

    async def body():
        for _ in range(round(200e6 / len(part)) + 1):
            yield part

    tracemalloc.start()
    try:
        with pytest.raises(RefusedError, match='larger than 200 MB'):
            asyncio.run(receive(tmp_path / 'large.bin', body(), round(200e6)))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()
    assert not any(tmp_path.iterdir())


def test_menus_become_options_and_earlier_jobs_say_how_long_one_takes(tmp_path):
    chosen = [['t', 'time', 'ms'], ['-p', 'rate, roll', ''], ['x', '', ''],
              ['b', 'motor 2', ''], ['a', 'motor 1', ''], ['q', 'angle, yaw', '']]
    assert named_columns(chosen) == [
        '--axis', 'roll', '--time', 't', '--rate=-p', '--motors', 'a,b', '--mixer', 'auto',
        '--unit', 't=ms']
    (tmp_path / 'flight.csv').write_bytes(bytes(1000))
    for number, seconds in ((1, 2.0), (2, 4.0), (3, 30.0)):
        (tmp_path / f'{number}').mkdir()
        (tmp_path / f'{number}' / JOB_FILE).write_text(json.dumps({
            'arguments': ['look'], 'state': 'done', 'size': 500, 'seconds': seconds}))
    job = Job(4, '', 'quad-sysid', ('look', str(tmp_path / 'flight.csv')), tmp_path / '4')
    assert expected(job) == pytest.approx(8.0)
    assert job.remaining_s() is None


def test_a_name_of_any_letters_fits_the_disk_and_a_bags_metadata_says_what_to_drop(tmp_path):
    for name in ('飛' * 119 + '.csv', '飛' * 119 + '.csv', 'a' * 5000 + '.ulg'):
        made = new_file(tmp_path, name)
        assert made.suffix == name[-4:]
        assert made.stat().st_size == 0
    with pytest.raises(RefusedError, match=r'\.mcap files alone'):
        new_file(tmp_path, 'my_flight/metadata.yaml')


def test_logs_that_are_to_be_identified_are_made_bags_with_names_of_their_own(tmp_path):
    for name in ('a.ulg', 'a.bin'):
        (tmp_path / name).write_bytes(b'ULog\x01\x12\x35')
    (tmp_path / 'a.csv').write_text('t,p\n0,1\n')
    asked = {'kind': 'identify', 'files': ['a.ulg', 'a.bin'], 'axis': 'roll'}
    *imports, last = commands(tmp_path, asked)
    bags = [one[2][-1] for one in imports]
    assert {one[2][0] for one in imports} == {'import'}
    assert last[2][:3] == ['identify', *bags]
    assert len({*bags}) == 2
    (again,) = commands(tmp_path, {'kind': 'import', 'files': ['a.ulg']}, {*bags})
    assert again[2][-1] not in bags
    for asked, words in (({'kind': 'inspect', 'files': ['a.ulg', 'a.bin']}, 'choose a single'),
                         ({'kind': 'identify', 'files': ['a.csv']}, 'Columns'),
                         ({'kind': 'import', 'files': ['a.csv']}, 'a.csv is a table.*Columns')):
        with pytest.raises(RefusedError, match=words):
            commands(tmp_path, asked)


def test_gains_for_px4_need_the_scale_of_each_axis(tmp_path):
    axes = {axis: {'gains': {'rate.kp': 0.1}} for axis in ('roll', 'pitch')}
    axes['climb'] = {'verdict': 'cannot_tell'}  # whose next flight is a launch file's
    (tmp_path / 'report.json').write_text(json.dumps({'axes': axes}))
    (tmp_path / 'model.json').write_text('{}')
    asked = {'kind': 'export', 'files': ['model.json'], 'to': 'px4'}
    for scale in ('', '1', '0.25,-1', '1,x'):
        with pytest.raises(RefusedError, match='scale: a number is missing for roll, pitch'):
            commands(tmp_path, asked | {'scale': scale})
    (command,) = commands(tmp_path, asked | {'scale': '0.25, 0.5'})
    assert command[2][-4:] == ['--scale', 'roll=0.25', '--scale', 'pitch=0.5']
    with pytest.raises(RefusedError, match='no schedule follows from the report of climb'):
        commands(tmp_path, {'kind': 'schedule', 'files': ['model.json'], 'axis': 'climb'})


def test_jobs_without_their_bag_of_an_earlier_start_or_many_at_once_are_in_the_queue(tmp_path):
    (tmp_path / 'log.bin').write_bytes(b'\xa3\x95')
    queue = Queue(tmp_path / 'results')
    made = queue.add('import log.bin', 'quad-sysid', ['import', str(tmp_path / 'log.bin')])
    after = queue.add('identify', 'quad-sysid', ['identify', str(tmp_path / 'bag')], after=[made])
    until(lambda: after.ended)
    queue.close()
    assert made.state == after.state == 'failed'
    assert 'log.bin' in made.doing
    assert after.doing == f'import log.bin: {made.doing}'
    assert after.text().splitlines() == [after.doing]
    note = after.folder / JOB_FILE
    note.write_text(note.read_text().replace('"failed"', '"running"'))  # as a kill leaves it
    (made.folder.parent / 'other').mkdir()
    (made.folder.parent / 'other' / JOB_FILE).write_text('{}')
    later, earlier = Queue(tmp_path / 'results').all()
    assert (earlier.title, earlier.state, earlier.text()) == (made.title, 'failed', made.text())
    assert (later.state, later.doing) == ('stopped', 'the app ended first: start it again')
    many = [('import', 'quad-sysid', ['import'])] * (MOST_WAITING + 2)
    assert len(queue.add_all(many).after) == MOST_WAITING + 1  # which wait: it is closed
    with pytest.raises(RefusedError, match='20 jobs wait already'):
        queue.add_all(many)


def test_a_folder_that_is_gone_or_has_an_app_is_one_line(started, tmp_path, refused):
    folder = tmp_path / 'flights'
    folder.mkdir()
    process, server = started(folder)
    assert 'flights: has an app that runs' in refused(main, 'app', folder, '--no-browser')
    folder.rmdir()
    status, text = server.ask('/upload?name=a.csv', b't\n')
    assert status == 400
    assert json.loads(text)['error'].startswith('a.csv: No such file or directory; check')
    status, text = server.ask('/upload?name=a.exe', b't\n')
    assert json.loads(text)['error'].startswith('a.exe: no log by its name')
    assert process.end() in (0, 130)


@pytest.mark.parametrize('said', ['', 'quad-sysid: a: is bad\n'])
def test_progress_that_was_wiped_is_not_in_the_text_of_a_job(tmp_path, said):
    terminal, command = os.pipe()
    os.write(command, f'\r\x1b[2Kreading\r\x1b[2Kdrawing\r\x1b[2K{said}'.encode())
    os.close(command)
    job = Job(1, 'look', 'quad-sysid', ('look',), tmp_path)
    follow(job, terminal)
    assert job.text() == said


def test_an_error_stands_on_a_line_of_its_own_after_progress(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True)
    assert main(['look', 'nothing_here']) == 2
    assert capsys.readouterr().err.startswith('\r\x1b[2Kquad-sysid: nothing_here: ')


class Chromium:
    """A headless browser over the pipe of its DevTools protocol."""

    def __init__(self, folder: Path) -> None:
        (to_read, self._out), (self._in, to_write) = os.pipe(), os.pipe()
        command = [BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--no-first-run',
                   '--disable-dev-shm-usage', '--disable-background-networking',
                   f'--user-data-dir={folder}', '--window-size=1280,1400',
                   '--remote-debugging-pipe', 'about:blank']
        # the browser reads from 3 and writes to 4
        self.process = subprocess.Popen(
            ['bash', '-c', f'exec "$@" 3<&{to_read} 4>&{to_write}', 'bash', *command],
            pass_fds=(to_read, to_write), stderr=subprocess.DEVNULL)
        os.close(to_read)
        os.close(to_write)
        self._rest, self._number, self.session, self.errors = b'', 0, None, []
        (target, *_) = (t['targetId'] for t in self.send('Target.getTargets')['targetInfos']
                        if t['type'] == 'page')
        self.attach(target)

    def attach(self, target):
        self.session = None
        self.session = self.send('Target.attachToTarget', targetId=target,
                                 flatten=True)['sessionId']
        for domain in ('Page', 'Runtime', 'DOM', 'Log'):
            self.send(f'{domain}.enable')

    def other_tab(self, url):
        """Go on in a new tab, which an answer finds where it was asked: it navigates first."""
        self.session = None
        self.attach(self.send('Target.createTarget', url='about:blank')['targetId'])
        self.send('Page.navigate', url=url)

    def send(self, method, **parameters):
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': parameters}
        if self.session:
            message['sessionId'] = self.session
        os.write(self._out, json.dumps(message).encode() + b'\0')
        while True:
            while b'\0' not in self._rest:
                assert select.select([self._in], [], [], ANSWER_S)[0], f'no answer: {method}'
                self._rest += os.read(self._in, 1 << 16)
            raw, _, self._rest = self._rest.partition(b'\0')
            answer = json.loads(raw)
            if answer.get('method') in ('Runtime.exceptionThrown', 'Log.entryAdded'):
                entry = answer['params'].get('entry', answer['params'])
                if entry.get('level', 'error') == 'error':
                    self.errors.append(entry)
            if answer.get('id') == self._number:
                assert 'error' not in answer, answer
                return answer['result']

    def run(self, script):
        """The value of a script, awaited."""
        found = self.send('Runtime.evaluate', expression=script, awaitPromise=True,
                          returnByValue=True)
        assert 'exceptionDetails' not in found, found
        return found['result'].get('value')

    def choose(self, *names):
        self.run(f"""document.querySelectorAll('#files input').forEach(box => {{
            box.checked = {json.dumps(names)}.some(n => box.parentElement.innerText.includes(n));
            box.onchange(); }});""")

    def press(self, button, words=''):
        """Press a button by the keyboard; then wait until the result shows this."""
        self.run(f"document.getElementById('{button}').focus()")
        self.key('Enter', 13)
        if words:
            self.until(f"document.getElementById('text').innerText.includes({words!r})")

    def until(self, script):
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            value = self.run(script)
            if value:
                return value
            time.sleep(0.2)
        raise AssertionError(f'never: {script}: {self.run("document.body.innerText")}')

    def fits(self, width, *, dark=False):
        """Whether the page does not scroll sideways on a screen of this width."""
        scheme = {'name': 'prefers-color-scheme', 'value': 'dark' if dark else 'light'}
        self.send('Emulation.setEmulatedMedia', features=[scheme])
        self.send('Emulation.setDeviceMetricsOverride', width=width, height=900,
                  deviceScaleFactor=1, mobile=False)
        return self.run('document.documentElement.scrollWidth <= window.innerWidth')

    def brightness(self, property_of):
        """Of a colour, the mean of its three parts, 0 to 255."""
        shown = re.findall(r'\d+', self.run(f'getComputedStyle({property_of}'))
        return sum(map(int, shown[:3])) / 3

    def drag(self, x, y, to_x):
        for kind, at in (('mousePressed', x), ('mouseMoved', (x + to_x) / 2),
                         ('mouseMoved', to_x), ('mouseReleased', to_x)):
            self.send('Input.dispatchMouseEvent', type=kind, x=at, y=y, clickCount=1,
                      button='left', buttons=0 if kind == 'mouseReleased' else 1)

    def key(self, name, code):
        for kind in ('keyDown', 'keyUp'):
            self.send('Input.dispatchKeyEvent', type=kind, key=name, windowsVirtualKeyCode=code,
                      text='\r' if name == 'Enter' and kind == 'keyDown' else '')

    def close(self):
        with contextlib.suppress(OSError):
            os.close(self._out)
        self.process.terminate()
        self.process.wait(PATIENCE_S)


@pytest.fixture
def browser(tmp_path):
    """With nothing logged as an error in the end."""
    if not BROWSER:
        pytest.skip('no Chromium here (apt-get install chromium)')
    chromium = Chromium(tmp_path / 'profile')
    yield chromium
    chromium.close()
    assert not chromium.errors, chromium.errors


@pytest.mark.browser
def test_a_flight_is_dropped_looked_at_and_a_window_drawn_by_the_mouse(server, browser, tmp_path):
    log = tmp_path / 'dropped.csv'
    flight = fly(Airframe(X), 1, 20.0)
    torque = flight['motors'] @ MIXER_INVERSE[1:].T
    np.savetxt(log, np.column_stack([DT * np.arange(len(torque)), torque, flight['rates']]),
               '%.5g', ',', header='@timestamp,tau_x,tau_y,tau_z,wobble,gy,gz', comments='')
    browser.send('Page.navigate', url=server.address)
    browser.until("document.querySelectorAll('#files input').length === 1")
    browser.run("document.getElementById('train').value = '1:2'")
    root = browser.send('DOM.getDocument')['root']['nodeId']
    node = browser.send('DOM.querySelector', nodeId=root, selector='#file')['nodeId']
    browser.send('DOM.setFileInputFiles', nodeId=node, files=[str(log)])
    browser.until("document.querySelectorAll('#files input').length === 2")
    assert browser.run("document.getElementById('train').value") == ''
    browser.choose('my_flight')
    browser.run("""document.querySelector('input[value=train]').click();
        document.getElementById('look').click();""")
    browser.until("!document.getElementById('frame').hidden")
    place = browser.run("""(() => { const f = document.getElementById('frame');
        f.scrollIntoView(); const r = f.getBoundingClientRect();
        return [r.x, r.y, r.width]; })()""")
    browser.until("document.getElementById('frame').dataset.traces > 0")
    for down in range(300, 620, 40):
        browser.drag(place[0] + 0.3 * place[2], place[1] + down, place[0] + 0.6 * place[2])
    value = browser.until("document.getElementById('train').value")
    start, stop = map(float, value.split(':'))
    assert 0.0 < start < stop < 30.0
    # a report has an origin of its own: it can ask this server for nothing
    assert browser.run("""(() => { try { document.getElementById('frame').contentDocument.body;
        return document.getElementById('frame').contentDocument === null; }
        catch (e) { return true; } })()""")
    # a column that no guess knows is corrected by its menu, with the keyboard alone
    wanted = {'file', 'look', 'columns', 'identify', 'export', 'train', 'axis'}
    for _ in range(200):  # a report in the frame has stops of its own
        browser.key('Tab', 9)
        wanted.discard(browser.run('document.activeElement.id'))
        if not wanted:
            break
    assert not wanted
    browser.choose('dropped')
    browser.run("document.querySelector('#jobs button').isTheSame = true")
    browser.press('columns')
    browser.until("!document.getElementById('menus').hidden")
    browser.choose('my_flight')  # the menus are those of the table all the same
    browser.run("""(() => {
        const one = document.querySelector('tr[data-column=wobble] select');
        one.value = 'rate, roll'; one.onchange();
        document.getElementById('take').focus(); })()""")
    browser.key('Enter', 13)
    browser.until("document.getElementById('files').innerText.includes('dropped_bag')")
    # a line of the list is not made anew while it is pressed, or has the keyboard
    assert browser.run("[...document.querySelectorAll('#jobs button')].some(b => b.isTheSame)")
    # a second tab sees the same jobs
    browser.other_tab(server.base + '/')
    browser.until("document.getElementById('jobs')?.innerText.includes('import dropped')")
    assert browser.fits(1280)
    assert browser.fits(390, dark=True)
    assert browser.brightness('document.body).backgroundColor') < 60


@pytest.mark.browser
def test_a_flight_is_identified_stopped_compared_and_its_gains_are_exported(server, browser):
    """And its report, opened by itself: sizes and colours at the widths of desktop and phone."""
    shown = "document.getElementById('frame').src.endsWith('{}')"
    browser.send('Page.navigate', url=server.address)
    browser.until("document.querySelectorAll('#files input').length >= 1")
    assert browser.fits(390)
    browser.choose('my_flight')
    browser.run("""document.getElementById('axis').value = 'roll';
        document.getElementById('train').value = '3:12';
        document.getElementById('validate').value = '15:25';
        document.getElementById('frame').hidden = false;""")  # the page of another job
    listed = "document.getElementById('jobs').innerText"
    browser.press('identify')
    browser.press('inspect')  # which waits in the queue
    browser.until(f"{listed}.includes('running') && {listed}.includes('waiting')")
    browser.until("""document.getElementById('title').innerText.endsWith('t, waiting')
        && document.getElementById('frame').hidden""")
    browser.until("document.querySelector('[aria-label^=\"stop identify\"]')?.click() || true")
    browser.until(f"{listed}.includes('stopped')")
    browser.until(shown.format('inspect.html'))
    browser.press('identify')
    browser.until(shown.format('report.html'))
    assert browser.run('history.length') == 2  # Back brings no other job's page below its title
    model = next(one for one in server.folder.rglob('model.json'))
    shutil.copytree(model.parent, server.folder / 'older')
    browser.press('inspect')  # with the next job the list of files is renewed
    browser.until("document.getElementById('files').innerText.includes('older')")
    browser.choose('model.json')
    assert browser.run("document.getElementById('train').value") == ''
    browser.press('compare', 'nothing changed')
    browser.choose('older')
    browser.run("document.getElementById('to').value = 'px4'")
    browser.press('export')
    browser.until("document.getElementById('say').innerText.includes('scale: a number is missin')")
    browser.errors.clear()  # that it was refused
    browser.run("document.getElementById('scale').value = '0.25'")
    browser.press('export', 'MC_ROLLRATE_P')
    assert browser.fits(390)
    browser.send('Page.navigate', url=(model.parent / 'report.html').as_uri())
    browser.until("document.querySelectorAll('figure svg text').length > 0")
    browser.until("!!document.querySelector('.zoom')?.group")
    # on paper the bars of the ladder keep their ink, and nothing asks to be pressed
    browser.send('Emulation.setEmulatedMedia', media='print')
    assert browser.run("""(() => {
        const of = name => getComputedStyle(document.querySelector(name));
        return of('.answer').webkitPrintColorAdjust === 'exact'
            && of('button').display === 'none';
        })()""")
    browser.send('Emulation.setEmulatedMedia', media='')
    # however large the motion, two values at least are written beside each row
    assert browser.run("""(() => { const {group} = document.querySelector('.zoom'); let fewest = 9;
        for (const factor of [1, 1.3, 1.3, 1.3, 1.3, 1.3, 1.3]) for (const row of group.rows) {
            let count = 0; const g = row.canvas.getContext('2d'), fill = g.fillText;
            g.fillText = (...one) => { count += g.textAlign === 'right'; fill.apply(g, one); };
            row.row.lines.forEach(line => { line.scale *= factor; line.offset *= factor; });
            group.paint(row); g.fillText = fill; fewest = Math.min(fewest, count); }
        return fewest; })()""") >= 2
    for width, dark in ((1280, False), (520, True)):
        assert browser.fits(width, dark=dark)
        assert browser.run("""Math.min(...[...document.querySelectorAll('figure svg')].map(
            s => s.getBoundingClientRect().width))""") > 380
        assert browser.run("""Math.min(...[...document.querySelectorAll('figure svg text')].map(
            t => t.getBoundingClientRect().height))""") >= 9.0
        paper = browser.brightness('document.body).backgroundColor')
        ink = browser.brightness("document.querySelector('figure svg text')).fill")
        low, high = (paper, ink) if dark else (ink, paper)
        assert low < 60
        assert high > 180


@pytest.mark.browser
def test_sliders_redraw_the_step_and_the_margins_of_the_simulated_loop(browser, tmp_path):
    flown = CascadeGains(4.0, 0.07, 0.05, 0.0012, d_filter_hz=35.0)
    model = dataclasses.replace(model_of(),
                                active_gains=flown.to_mapping('roll', constants=True))
    (tmp_path / 'page.html').write_text(
        f'<html><body>{sliders.sliders(model, {})}{script("sliders.js")}</body></html>')
    browser.send('Page.navigate', url=(tmp_path / 'page.html').as_uri())
    browser.until("document.querySelectorAll('.tryout input').length === 4")
    found = browser.run("""(() => { const box = document.querySelector('.tryout');
        box.querySelectorAll('input').forEach((one, i) => {
            one.value = [0.4, -0.3, 0.5, 0.2][i]; one.oninput(); });
        return {...box.tryout.found, step: [...box.tryout.found.step]}; })()""")
    factors = 2.0 ** np.array([0.4, -0.3, 0.5, 0.2])
    names = ('angle_kp', 'rate_kp', 'rate_ki', 'rate_kd')
    gains = dataclasses.replace(flown, **{
        name: factor * getattr(flown, name) for name, factor in zip(names, factors, strict=True)})
    plant = loop_plant(model)
    step = simulate_cascade(plant, gains, np.full(300, 0.2), model.dt).angle / 0.2
    assert np.allclose(found['step'], step, atol=2e-3)
    omega = np.geomspace(0.5, 0.999 * np.pi / model.dt, 2000)
    loops = loops_of([(plant, WIDE)])
    of = margins(open_loop(gains, loops.response(omega), omega, model.dt), omega)
    assert found['phase'] == pytest.approx(of.phase_margin_deg[0], abs=0.5)
    assert found['gain'] == pytest.approx(of.gain_margin_db[0], abs=0.1)
    assert found['cross'] == pytest.approx(of.crossover_rad_s[0], rel=0.01)
    assert found['worst'] == pytest.approx(of.peak_sensitivity[0], rel=0.01)


@pytest.mark.browser
def test_what_is_dropped_is_named_and_a_server_that_has_ended_too(
        started, browser, tmp_path, plain_bag):
    (tmp_path / 'flights').mkdir()
    process, server = started(tmp_path / 'flights')
    long = tmp_path / f'{40 * "long"}.csv'
    for name, content in ((long, 't\n'), ('a.csv', 't\n'), ('notes.doc', 'x'),
                          ('big.bin', 'x' * 1_100_000)):
        (tmp_path / name).write_text(content)
    for url in (server.address, started(tmp_path)[1].address):  # and the app of another folder
        browser.send('Page.navigate', url=url)
        browser.until("!!document.querySelector('#files li')")
    browser.send('Page.navigate', url=f'{server.base}/')
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
    drop(long)
    browser.until(f"{said}.includes('{long.name} is there')")
    assert browser.fits(390)
    drop(shutil.copytree(plain_bag, tmp_path / 'day' / 'first').parent)  # of folders
    browser.until(f"{said}.includes('.mcap')")
    browser.choose('a_2.csv')
    drop(tmp_path / 'notes.doc')
    browser.until(f"{said}.includes('notes.doc: no log')")
    assert browser.run("document.querySelectorAll('#files :checked').length") == 1
    browser.run("dispatchEvent(new DragEvent('drop', {dataTransfer: new DataTransfer()}))")
    assert browser.run(f"{said}.includes('no log was dropped')")
    (tmp_path / 'flights' / 'copied.csv').write_text('t\n')
    browser.run("document.dispatchEvent(new Event('visibilitychange'))")
    browser.until("document.getElementById('files').innerText.includes('copied.csv')")
    # the answer to the first of two requests is the later one
    browser.run("""new Promise(both => { const own = fetch; let asked = 0, answered = 0;
        window.fetch = async (path, more) => {
            const post = more && ++asked, answer = await own(path, more);
            if (post === 1) await new Promise(later => setTimeout(later, 1000));
            if (post && ++answered === 2) setTimeout(both, 300);
            return answer; };
        for (const id of ['look', 'inspect']) document.getElementById(id).click(); })""")
    browser.until("document.getElementById('title').innerText.startsWith('inspect')")
    process.end()
    browser.until(f"{said}.includes('start quad-sysid app again')")
    browser.errors.clear()  # that the connection was refused
