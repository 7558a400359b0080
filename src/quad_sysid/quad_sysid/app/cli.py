"""`quad-sysid app`: the command; what it needs beyond the others is an extra, `[app]`."""

from __future__ import annotations

import argparse
import fcntl
import os
import socket
from pathlib import Path

from quad_sysid.arguments import Commands, command, positive
from quad_sysid.errors import BadInputError


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'app', _run,
        'Look at logs, identify and compare in a browser, on this machine only.',
        'quad-sysid app my_flights',
    )
    parser.add_argument('folder', metavar='FOLDER', nargs='?', type=Path, default=Path(),
                        help='the logs and bags that are shown; dropped files and results go '
                        'there (default: this folder)')
    parser.add_argument('--port', type=int, default=0,
                        help='port on 127.0.0.1 (default: a free one)')
    parser.add_argument('--most-mb', metavar='MB', type=float, default=200.0,
                        help='largest file that may be dropped (default %(default)g)')
    parser.add_argument('--no-browser', action='store_true', help='print the address only')


def _run(options: argparse.Namespace) -> int:
    try:
        import uvicorn

        from quad_sysid.app.server import App
    except ImportError as error:
        raise BadInputError('app', f'needs the package {error.name}',
                            remedy='pip install starlette uvicorn') from error
    if not options.folder.is_dir():
        raise BadInputError(str(options.folder), 'is no folder', remedy='name one with logs')
    if not 0 <= options.port <= 65535:
        raise BadInputError('--port', 'must be 0 to 65535', options.port)
    most_mb = positive('--most-mb', options.most_mb)
    try:  # until this process ends
        fcntl.flock(os.open(options.folder, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:  # which would show the jobs of the other one as stopped
        raise BadInputError(str(options.folder), 'has an app that runs',
                            remedy='open the address that it printed, or end it') from error
    except OSError:
        pass  # a file system without locks
    app = App(options.folder, most_mb)
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        line.bind(('127.0.0.1', options.port))
        line.listen()  # from here on a browser waits for the server
    except OSError as error:
        raise BadInputError('--port', 'is taken', options.port, 'choose another') from error
    address = f'http://127.0.0.1:{line.getsockname()[1]}/?token={app.token}'
    print(f'{address}\nCtrl-C ends it.', flush=True)
    if not options.no_browser:
        import webbrowser

        webbrowser.open(address)
    server = uvicorn.Server(uvicorn.Config(app.starlette(), log_level='warning',
                                           server_header=False, timeout_graceful_shutdown=2))
    server.run(sockets=[line])
    return 0
