"""A folder of bags or of results, on this machine or on an object store.

A path, and an address of `file://`, is of this machine. Any other address is opened by fsspec
(s3://, gs://, memory://), which the extra `cluster` brings; what an address needs beside it, such
as s3fs and its credentials, is fsspec's to say.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.files import encoded, make_folder, write_whole

ENDS = 65_536
"""Bytes at the start and at the end of a file by which its content is known."""


class Place:
    """One folder; the names of its files are relative to it, with slashes."""

    def __init__(self, address: str | os.PathLike[str]) -> None:
        self.address = str(address)
        scheme, separator, path = self.address.partition('://')
        self.path = Path(path if scheme == 'file' and separator else self.address)
        """Where it is, of this machine."""
        self.store: Any = None
        """fsspec's file system, elsewhere."""
        if separator and scheme != 'file':
            self.store, self._root = _opened(self.address)
        else:
            self.address = str(self.path.resolve())

    def files(self) -> dict[str, tuple[int, str]]:
        """Every file below, behind links too, sorted: its size and when it was changed.

        A folder that cannot be opened stands there as a file of no size.
        """
        files: dict[str, tuple[int, str]] = {}
        if self.store is not None:
            for path, about in self.store.find(self._root, detail=True).items():
                name = path[len(self._root):].lstrip('/')
                mark = next((about[k] for k in ('ETag', 'etag', 'mtime', 'created')
                             if k in about), '')
                files[name] = int(about['size']), str(mark)
            return dict(sorted(files.items()))
        closed: list[OSError] = []
        for root, folders, names in os.walk(self.path, onerror=closed.append, followlinks=True):
            folders[:] = [name for name in folders if not _leads_back(Path(root, name))]
            for path in (Path(root, name) for name in names):
                try:
                    about = path.stat()
                except OSError:  # a link to nothing
                    continue
                files[path.relative_to(self.path).as_posix()] = (
                    about.st_size, str(about.st_mtime_ns))
        for error in closed:
            files[Path(error.filename).relative_to(self.path).as_posix()] = 0, 'closed'
        return dict(sorted(files.items()))

    def ends(self, name: str, size: int) -> bytes:
        """The first and the last bytes of a file."""
        if self.store is not None:
            path = self._in_store(name)
            return bytes(self.store.cat_file(path, start=0, end=min(ENDS, size))
                         + self.store.cat_file(path, start=max(0, size - ENDS), end=size))
        with (self.path / name).open('rb') as stream:
            first = stream.read(ENDS)
            stream.seek(max(0, size - ENDS))
            return first + stream.read(ENDS)

    def read(self, names: Sequence[str]) -> dict[str, bytes]:
        """The content of those of the files that are there."""
        if self.store is not None:
            paths = {self._in_store(name): name for name in names}
            got = self.store.cat(list(paths), on_error='omit') if paths else {}
            return {paths[path]: content for path, content in got.items()}
        own = {name: self.path / name for name in names}
        return {name: path.read_bytes() for name, path in own.items() if path.is_file()}

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file, which appears when it is whole. Raises BadInputError."""
        if self.store is None:
            make_folder((self.path / name).parent)
            write_whole(self.path / name, content)
            return
        try:
            self.store.makedirs(PurePosixPath(self._in_store(name)).parent.as_posix(),
                                exist_ok=True)
            self.store.pipe_file(self._in_store(name), encoded(content))
        except Exception as error:
            raise BadInputError(f'{self.address}/{name}', 'cannot be written',
                                f'{type(error).__name__}: {error}',
                                'check address and permissions') from error

    def remove(self, name: str, *, whole: bool = False) -> None:
        """Remove a file, or a folder with all that is in it."""
        if self.store is not None:
            with suppress(FileNotFoundError):
                self.store.rm(self._in_store(name), recursive=whole)
        elif whole:
            shutil.rmtree(self.path / name, ignore_errors=True)
        else:
            (self.path / name).unlink(missing_ok=True)

    @contextmanager
    def fetched(self, bag: str, names: Sequence[str]) -> Iterator[Path]:
        """The bag or log on this machine, for as long; from a store its files come in blocks."""
        if self.store is None:
            yield self.path / bag
            return
        with tempfile.TemporaryDirectory(prefix='quad_sysid_') as copy:
            for name in names:
                target = Path(copy, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                self.store.get_file(self._in_store(name), str(target))
            yield Path(copy, bag)

    @contextmanager
    def filled(self, folder: str) -> Iterator[Path]:
        """A folder below to write files into; of a store, they are sent at the end."""
        if self.store is None:
            yield self.path / folder
            return
        with tempfile.TemporaryDirectory(prefix='quad_sysid_') as copy:
            yield Path(copy, 'new')
            for path in sorted(Path(copy, 'new').rglob('*')):
                if path.is_file():
                    name = path.relative_to(Path(copy, 'new')).as_posix()
                    self.write(f'{folder}/{name}', path.read_bytes())

    def _in_store(self, name: str) -> str:
        return f'{self._root}/{name}'


def _leads_back(folder: Path) -> bool:
    """Whether it is a link to a folder in which it lies."""
    return folder.is_symlink() and folder.resolve() in {one.resolve() for one in folder.parents}


def _opened(address: str) -> tuple[Any, str]:
    """The file system of an address by fsspec, and the path in it."""
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise BadInputError(address, 'needs the package fsspec',
                            remedy="pip install 'quad_sysid[cluster]'") from error
    opened: Callable[..., tuple[Any, str]] = url_to_fs
    try:
        store, root = opened(address)
    except (ImportError, ValueError) as error:
        raise BadInputError(address, 'cannot be opened', str(error),
                            'name a folder, or an address that fsspec knows') from error
    return store, root.rstrip('/')
