"""The picture of the app in docs/images: a simulated flight, looked at. `make app-picture`."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from quad_sysid.app.server import COOKIE

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / 'docs/images/app.png'
PATIENCE_S = 300.0
WIDTH, HEIGHT = 1280, 1000


def main() -> int:
    """Fly, start the app, look, take the picture."""
    names = ('chromium', 'chromium-browser', 'google-chrome')
    browser = next((name for name in names if shutil.which(name)), '')
    if not browser:
        sys.stderr.write('app_picture: no Chromium here: apt-get install chromium\n')
        return 2
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / 'my_flights'
        folder.mkdir()
        subprocess.run([sys.executable, ROOT / 'tools/flight.py', folder], check=True)
        start = [sys.executable, '-c', 'from quad_sysid.start import main; main()']
        server = subprocess.Popen([*start, 'app', 'my_flights', '--no-browser'], cwd=made,
                                  stdout=subprocess.PIPE, text=True)
        try:
            address = (server.stdout or sys.stdin).readline().strip()
            _look(address)
            subprocess.run([browser, '--headless', '--no-sandbox', '--disable-gpu',
                            '--hide-scrollbars', f'--user-data-dir={made}/profile',
                            '--disable-features=IsolateSandboxedIframes',
                            '--disable-site-isolation-trials',
                            '--run-all-compositor-stages-before-draw',
                            f'--window-size={WIDTH},{HEIGHT}', '--virtual-time-budget=20000',
                            f'--screenshot={made}/app.png', address], check=True,
                           stderr=subprocess.DEVNULL)
        finally:
            server.terminate()
            server.wait()
        _small(Path(made) / 'app.png')
    sys.stdout.write(f'{TARGET.relative_to(ROOT)}: {TARGET.stat().st_size / 1e3:.0f} kB\n')
    return 0


def _look(address: str) -> None:
    base, _, token = address.partition('/?token=')
    name = COOKIE.format(base.rpartition(':')[2])
    cookie = {'Cookie': f'{name}={token}'}

    def ask(path: str, data: bytes | None = None) -> object:
        request = urllib.request.Request(base + path, data, cookie)
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return json.loads(answer.read())

    ask('/jobs', json.dumps({'kind': 'look', 'files': ['my_flight']}).encode())
    end = time.monotonic() + PATIENCE_S
    while ask('/jobs')[0]['state'] in ('waiting', 'running'):  # type: ignore[index]
        if time.monotonic() > end:
            raise SystemExit('app_picture: the look takes too long')
        time.sleep(0.5)


def _small(picture: Path) -> None:
    from PIL import Image

    with Image.open(picture) as image:
        image.convert('P', palette=Image.Palette.ADAPTIVE, colors=64).save(TARGET, optimize=True)


if __name__ == '__main__':
    sys.exit(main())
