"""The app's pages and requests, by Starlette: who may ask, what is asked for, what comes back.

Only this machine is answered: the socket is bound to 127.0.0.1, a request needs the token of the
address (then a cookie), its Host must be ours (else another name could point here), and one that
changes anything must come from our own page. Reports are shown in a sandbox without our origin.
"""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from starlette import responses
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from quad_sysid.app.commands import commands
from quad_sysid.app.folder import (
    RESULTS,
    RefusedError,
    entries,
    new_file,
    receive,
    safe_name,
    too_large,
)
from quad_sysid.app.jobs import Job, Queue
from quad_sysid.files import escaped, unfinished
from quad_sysid.report.style import SHEET

COOKIE = 'quad_sysid_token_{}'
"""With the port: a browser sends the cookies of all ports of a host, those of other apps too."""
MOST_REQUEST = 100_000
"""Bytes of a request that is no upload."""
HERE = Path(__file__).parent
OWN_POLICY = ("default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
              "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; "
              "frame-ancestors 'none'")
REPORT_POLICY = ("sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
                 "style-src 'unsafe-inline'; img-src data:")
"""What a report may do: run its own scripts, in an origin of its own, and load nothing."""
PAGES = ('look.html', 'inspect.html', 'result/report.html')

Handler = Callable[[Request], Awaitable[Response]]


class App:
    """The folder, the queue and the token behind the routes."""

    def __init__(self, folder: Path, most_mb: float) -> None:
        self.folder, self.most_bytes = folder, int(1e6 * most_mb)
        self.token = secrets.token_urlsafe(24)
        self.queue = Queue(folder.resolve() / RESULTS)

    def starlette(self) -> Starlette:
        """The application that a server runs."""

        @asynccontextmanager
        async def lifespan(_: Starlette) -> Any:
            yield
            self.queue.close()

        routes = [
            Route('/', self._guarded(self._home)),
            Route('/app.js', self._guarded(self._script)),
            Route('/app.css', self._guarded(self._style)),
            Route('/files', self._guarded(self._files)),
            Route('/upload', self._guarded(self._upload), methods=['POST']),
            Route('/jobs', self._guarded(self._jobs)),
            Route('/jobs', self._guarded(self._start), methods=['POST']),
            Route('/jobs/{number:int}/stop', self._guarded(self._stop), methods=['POST']),
            Route('/jobs/{number:int}/text', self._guarded(self._text)),
            Route('/jobs/{number:int}/{name:path}', self._guarded(self._page)),
        ]
        return Starlette(routes=routes, lifespan=lifespan)

    def _guarded(self, handler: Handler) -> Handler:
        async def guarded(request: Request) -> Response:
            refused = self._refusal(request)
            if refused:
                return Response(refused, 403, media_type='text/plain')
            if request.query_params.get('token'):  # from now on by the cookie
                answer: Response = responses.RedirectResponse(request.url.path, 303)
                answer.set_cookie(COOKIE.format(request.url.port), self.token, httponly=True,
                                  samesite='strict')
                return _sealed(answer)
            try:
                return _sealed(await handler(request))
            except RefusedError as error:
                return _sealed(_json({'error': str(error)}, 400))
            except OSError as error:
                where = Path(error.filename or self.folder).name
                return _sealed(_json({'error': f'{where}: {_why(error)}'}, 400))
            except ClientDisconnect:
                return Response(status_code=499)

        return guarded

    def _refusal(self, request: Request) -> str:
        """Why a request is not answered; '' where it may be."""
        port = request.url.port
        hosts = {f'{name}:{port}' for name in ('127.0.0.1', 'localhost')}
        host = request.headers.get('host', '')
        if host not in hosts:
            return 'this page is for this machine only'
        origin, site = request.headers.get('origin'), request.headers.get('sec-fetch-site')
        if origin is not None and origin != f'http://{host}':
            return 'a request of another page'
        if request.method != 'GET' and site not in (None, 'same-origin'):
            return 'a request of another page'
        token = request.query_params.get('token') or request.cookies.get(COOKIE.format(port), '')
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return 'open the address that quad-sysid app printed, with its token'
        return ''

    async def _home(self, _: Request) -> Response:
        page = (HERE / 'app.html').read_text(encoding='utf-8')
        page = page.replace('MOST_BYTES', str(self.most_bytes))
        name = escaped(self.folder.resolve().name)
        return responses.HTMLResponse(page.replace('FOLDER', escape(name)))

    async def _script(self, _: Request) -> Response:
        return responses.FileResponse(HERE / 'app.js', media_type='text/javascript')

    async def _style(self, _: Request) -> Response:
        styles = (HERE / 'app.css').read_text(encoding='utf-8')
        return Response(SHEET + styles, media_type='text/css')

    async def _files(self, _: Request) -> Response:
        return _json([asdict(entry) for entry in entries(self.folder)])

    async def _upload(self, request: Request) -> Response:
        name = request.query_params.get('name', '')
        try:
            path = await self._received(name, request)
        except RefusedError as error:
            raise RefusedError(f'{name[-60:]}: {error}') from error
        except OSError as error:
            raise RefusedError(f'{name[-60:]}: {_why(error)}') from error
        return _json({'path': path.name})

    async def _received(self, name: str, request: Request) -> Path:
        length = request.headers.get('content-length', '')
        if length.isdigit() and int(length) > self.most_bytes:
            raise RefusedError(too_large(self.most_bytes))
        safe_name(name)
        with unfinished(self.folder) as aside:  # not listed, nor cut off where the app is killed
            upload = new_file(aside, name)
            await receive(upload, request.stream(), self.most_bytes)
            return upload.replace(new_file(self.folder, upload.name))

    async def _jobs(self, _: Request) -> Response:
        return _json([_job_tree(job) for job in self.queue.all()])

    async def _start(self, request: Request) -> Response:
        raw = b''
        async for part in request.stream():
            raw += part
            if len(raw) > MOST_REQUEST:
                raise RefusedError('too long')
        try:
            request_tree = dict(json.loads(raw))
        except (ValueError, TypeError) as error:
            raise RefusedError('is not JSON') from error
        asked = commands(self.folder, request_tree, self.queue.promised())
        return _json(_job_tree(self.queue.add_all(asked)))

    def _job(self, request: Request) -> Job:
        job = self.queue.get(request.path_params['number'])
        if job is None:
            raise RefusedError('no such job')
        return job

    async def _stop(self, request: Request) -> Response:
        job = self._job(request)
        await run_in_threadpool(self.queue.stop, job)
        return _json(_job_tree(job))

    async def _text(self, request: Request) -> Response:
        return Response(self._job(request).text(), media_type='text/plain; charset=utf-8')

    async def _page(self, request: Request) -> Response:
        job, name = self._job(request), request.path_params['name']
        path = job.folder / name
        if name not in PAGES or not path.is_file() or path.is_symlink():
            raise RefusedError('no such page')
        answer = responses.FileResponse(path, media_type='text/html')
        answer.headers['Content-Security-Policy'] = REPORT_POLICY
        return answer


def _json(content: Any, status: int = 200) -> Response:
    """An answer in ASCII: a file's name that is no UTF-8 goes to the page and back unchanged."""
    return Response(json.dumps(content, allow_nan=False), status, media_type='application/json')


def _why(error: OSError) -> str:
    return f'{error.strerror}; check the permissions of the folder, and the disk'


def _job_tree(job: Job) -> dict[str, Any]:
    pages = [name for name in PAGES if (job.folder / name).is_file()]
    return {'number': job.number, 'title': job.title, 'state': job.state, 'doing': job.doing,
            'seconds': round(job.seconds, 1), 'left': job.remaining_s(), 'pages': pages,
            'kind': job.arguments[0], 'files': job.arguments[1:2]}


def _sealed(answer: Response) -> Response:
    answer.headers.setdefault('Content-Security-Policy', OWN_POLICY)
    answer.headers['X-Content-Type-Options'] = 'nosniff'
    answer.headers['Referrer-Policy'] = 'no-referrer'
    answer.headers['Cross-Origin-Resource-Policy'] = 'same-origin'
    answer.headers['Cache-Control'] = 'no-store'
    return answer

