"""Files, read and written whole, or refused in one line."""

from __future__ import annotations

import io
import json
import os
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.interrupt import uninterrupted

UNFINISHED = '.unfinished_'
"""How the name of a folder begins that holds what is not whole yet."""
REPORT = 'quad_sysid/report/'
"""How the schema of report.json begins (contract)."""


def escaped(text: str) -> str:
    r"""Text that any file or page can hold: a byte of a file name that is no UTF-8 as \udce9."""
    return text.encode(errors='backslashreplace').decode()


def read_json(path: str | os.PathLike[str], remedy: str = '') -> Any:
    """Content of a JSON file; BadInputError, with `remedy` if it cannot be opened."""
    try:
        return json.loads(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise BadInputError(str(path), f'cannot be read ({error.strerror})', None,
                            remedy) from error
    except (ValueError, RecursionError) as error:  # no text, no JSON, endless digits or brackets
        value = 'no text' if isinstance(error, UnicodeDecodeError) else str(error)
        raise BadInputError(str(path), 'is not JSON', value,
                            'give a file that quad-sysid or quad-tune wrote') from error


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Say in one line why a file or folder cannot be read."""
    try:
        yield
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        remedy = 'copy it again: it was cut off or is damaged' if isinstance(
            error, EOFError | zlib.error) else 'check it and its permissions'
        raise BadInputError(str(path), f'cannot be read ({reason})', remedy=remedy) from error


@contextmanager
def read_by_library(path: str | os.PathLike[str], what: str, remedy: str) -> Iterator[None]:
    """Import a library and read `path` by it: any error becomes a BadInputError.

    `what` says that the file is damaged: a library raises whatever that makes it meet.
    """
    try:
        with redirect_stdout(io.StringIO()):  # some print what they find
            yield
    except ImportError as error:
        raise BadInputError(str(path), f'needs the package {error.name} to be read',
                            remedy=f'pip install {error.name}') from error
    except Exception as error:
        raise BadInputError(str(path), f'{what} ({type(error).__name__}: {error})',
                            remedy=remedy) from error


def check_own(folder: Path) -> None:
    """Raise BadInputError where a folder holds something, but no report of an identification.

    What an earlier identification left there is replaced by the next; what is not its own never.
    """
    try:
        there = [path.name for path in folder.iterdir() if not path.name.startswith(UNFINISHED)]
    except OSError:  # no folder yet, or none: `check_place`
        return
    try:
        report = json.loads((folder / 'report.json').read_text(encoding='utf-8'))
    except (OSError, ValueError, RecursionError):
        report = None
    own = isinstance(report, dict) and str(report.get('schema')).startswith(REPORT)
    if there and not own:
        raise BadInputError(str(folder), 'holds files, but no report of an identification',
                            min(there), 'name a new folder, or an empty one')


def check_page(path: Path, mark: str, command: str) -> None:
    """Raise BadInputError where a file exists that is no page of this command, by its mark."""
    if path.exists() and mark not in path.read_text(encoding='utf-8', errors='replace')[:2000]:
        raise BadInputError(str(path), f'exists, and is no page of quad-sysid {command}',
                            remedy='name another with --out')


@contextmanager
def unfinished(place: Path) -> Iterator[Path]:
    """A folder in `place` for what is not whole yet: it goes at the end, also of the process."""
    with uninterrupted():  # else it could be there before it is known
        folder = tempfile.TemporaryDirectory(dir=place, prefix=UNFINISHED)
    with folder:
        yield Path(folder.name)


def encoded(content: str | bytes) -> bytes:
    """The bytes of a file."""
    return escaped(content).encode() if isinstance(content, str) else content


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file so that it appears only when it is complete; raises BadInputError."""
    target = Path(path)
    try:
        with unfinished(target.parent) as folder, (folder / target.name).open('wb') as stream:
            stream.write(encoded(content))
            stream.flush()
            os.fsync(stream.fileno())
            (folder / target.name).replace(target)
    except OSError as error:
        raise BadInputError(str(target), 'cannot be written', error.strerror,
                            'choose another place') from error


def check_new(path: Path) -> None:
    """Raise BadInputError where a file of this name exists."""
    if path.exists():
        raise BadInputError(str(path), 'exists already', remedy='name another with --out')


def check_there(path: str | os.PathLike[str]) -> None:
    """Raise BadInputError where there is no such file or folder."""
    if not Path(path).exists():
        raise BadInputError(str(path), 'cannot be read: there is no such file or folder',
                            remedy='check the path')


def check_place(place: Path, *, folder: bool = True) -> Path:
    """The folder in which a folder, or else a file, can be written; leaves nothing.

    Of a folder the nearest that is there. Raises BadInputError where nothing can be written.
    """
    place = place.absolute()
    if not folder and place.is_dir():
        raise BadInputError('--out', f'{place} is a folder', remedy='name a file')
    there = next(p for p in (place, *place.parents) if p.exists()) if folder else place.parent
    if there.exists() and not there.is_dir():
        raise BadInputError('--out', f'{there} is not a folder', remedy='choose another place')
    try:
        with unfinished(there):  # as root, /proc says that it is writable
            pass
    except OSError as error:
        raise BadInputError('--out', f'{there} cannot be written', error.strerror,
                            'choose another place') from error
    return there


def free_folder(path: Path) -> Path:
    """`path`, or with .1, .2, … where that exists, so that nothing is overwritten."""
    folder = path
    number = 0
    while folder.exists():
        number += 1
        folder = path.with_name(f'{path.name}.{number}')
    return folder


def make_folder(folder: Path, option: str = '--out') -> Path:
    """The folder, created if missing; raises BadInputError naming the option."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(option, f'{folder} cannot be created', error.strerror,
                            'choose another place') from error
    return folder
