"""The folder of the app: what is in it, and that no name leads out of it. No HTTP here."""

from __future__ import annotations

import re
from collections.abc import AsyncIterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from quad_sysid.files import UNFINISHED

RESULTS = 'quad_sysid_app'
"""Folder, in that of the user, for results."""
SUFFIXES = ('.mcap', '.db3', '.ulg', '.bin', '.log', '.bbl', '.bfl', '.txt', '.csv', '.mat',
            '.bag', '.gz', '.xz', '.bz2', '.json')
MODEL, HEAD = b'"quad_sysid/model/', 64
"""With what the schema begins that opens a model's file, and the bytes in which it stands."""
MOST_FILES = 500
"""Files on a page that a reader still scans."""
ALLOWED = re.compile(r'[^\w.+\-() ]')
LONGEST_NAME = 200
"""Bytes of it: file systems take 255."""


class RefusedError(Exception):
    """A request that is not answered; its text is for the user."""


@dataclass(frozen=True)
class Entry:
    """A file or bag that can be chosen."""

    path: str
    """Relative to the folder, with slashes."""
    kind: str
    """`bag`, `log` or `model`."""
    megabytes: float


def inside(folder: Path, name: str) -> Path:
    """The file or folder of this relative name. Raises RefusedError where it lies elsewhere."""
    root = folder.resolve()
    if not name or '\0' in name:
        raise RefusedError('no such file')
    try:
        path = (root / name).resolve(strict=True)
    except (OSError, RuntimeError, ValueError) as error:
        raise RefusedError('no such file') from error
    if path == root or not path.is_relative_to(root):
        raise RefusedError('that file is not in the folder of the app')
    if not (path.is_file() or path.is_dir()):  # a named pipe, which would never answer
        raise RefusedError('no such file')
    return path


def is_bag(path: Path) -> bool:
    """Whether this is a bag by its name, as the page lists it."""
    return path.suffix == '.mcap' or (path / 'metadata.yaml').is_file()


def is_model(path: Path) -> bool:
    """Whether this is a model that `quad-sysid identify` wrote, whatever it is called."""
    try:
        with path.open('rb') as stream:
            return path.suffix == '.json' and MODEL in stream.read(HEAD)
    except OSError:
        return False


def entries(folder: Path) -> list[Entry]:
    """The files that can be chosen, by name; a bag is one entry."""
    root = folder.resolve()
    out: list[Entry] = []
    waiting = [(root, 0)]
    while waiting and len(out) < MOST_FILES:
        here, depth = waiting.pop()
        try:
            content = sorted(here.iterdir())
        except OSError:
            continue
        for path in content:
            if path.name.startswith(('.', UNFINISHED)) or path.is_symlink():
                continue
            with suppress(OSError):  # it has vanished, or may not be opened, such as lost+found
                if path.is_dir() and not is_bag(path):
                    waiting += [(path, depth + 1)] * (depth < 3)
                else:
                    out += _entry(path, root)
    return sorted(out, key=lambda e: e.path)


def _entry(path: Path, root: Path) -> list[Entry]:
    """The entry of a bag or file; none of what cannot be chosen, which is not opened.

    A named pipe would never answer. Raises OSError.
    """
    relative = path.relative_to(root)
    if path.is_dir():
        files = [f.stat().st_size for f in path.iterdir() if f.is_file()]
        return [Entry(relative.as_posix(), 'bag', sum(files) / 1e6)]
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return []
    if path.suffix == '.json':
        kind = 'model' if is_model(path) else ''
    elif RESULTS in relative.parts:
        kind = ''
    else:
        kind = 'bag' if is_bag(path) else 'log'
    return [Entry(relative.as_posix(), kind, path.stat().st_size / 1e6)] if kind else []


def safe_name(name: str) -> str:
    """The name for an upload. Raises RefusedError where it is of no known kind."""
    plain = ALLOWED.sub('_', re.split(r'[/\\]', name)[-1]).strip(' .')
    plain = plain.encode()[-LONGEST_NAME:].decode(errors='ignore').lstrip()
    if plain == 'metadata.yaml':
        raise RefusedError('of a bag drop its .mcap files alone: they hold all that is needed')
    if not plain.lower().endswith(SUFFIXES):
        raise RefusedError(f'no log by its name: known endings are {", ".join(SUFFIXES)}')
    return plain


def new_file(folder: Path, name: str) -> Path:
    """An empty file of a safe name, with a number where that is taken. Raises RefusedError."""
    plain = safe_name(name)
    stem, dot, ending = plain.partition('.')
    number = 1
    while True:
        target = folder / (plain if number == 1 else f'{stem}_{number}{dot}{ending}')
        try:
            target.touch(exist_ok=False)
        except FileExistsError:
            number += 1
        else:
            return target


async def receive(target: Path, body: AsyncIterable[bytes], most_bytes: int) -> None:
    """Fill a new file; RefusedError, and the file is gone, where it is of no use or too large."""
    is_complete, size = False, 0
    try:
        with target.open('wb') as stream:
            async for part in body:
                size += len(part)
                if size > most_bytes:
                    raise RefusedError(too_large(most_bytes))
                stream.write(part)
        if not size:
            raise RefusedError('is empty: copy it again')
        if target.suffix == '.json' and not is_model(target):
            raise RefusedError('is no model: drop the model.json of a result')
        is_complete = True
    finally:
        if not is_complete:
            target.unlink(missing_ok=True)  # noqa: ASYNC240  a moment


def too_large(most_bytes: int) -> str:
    """Why a file is refused that is larger."""
    return f'larger than {most_bytes / 1e6:.0f} MB: start quad-sysid app with a larger --most-mb'
