"""Zstandard and LZ4 behind one table: what chunks and messages of a bag may be compressed with.

Python 3.14 has zstd, before that the backport that rosbags brings along.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
ZSTD_LEVEL = 1
"""Twice as fast as zstd's usual level 3, and on flight data as small to within a few per cent."""

CODECS = ('', 'zstd', 'lz4')
"""Names of the compressions in an mcap file."""

DecompressError: tuple[type[Exception], ...] = (
    zstd.ZstdError, RuntimeError, EOFError, MemoryError,
)  # fmt: skip
"""What damaged content raises."""


def zstd_compress(data: bytes) -> bytes:
    """One zstd frame."""
    return zstd.compress(data, ZSTD_LEVEL)


def lz4_compress(data: bytes) -> bytes:
    """One LZ4 frame, as MCAP asks for it."""
    return bytes(lz4.frame.compress(data))


COMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    'none': bytes,
    'zstd': zstd_compress,
    'lz4': lz4_compress,
}


def decompress(
    name: str, packed: bytes, piece: int = 4096, *, cut_off: bool = False
) -> tuple[bytes, bool]:
    """Content as far as it can be had, and whether that is all; `name` as MCAP writes it.

    `cut_off`: nothing but the end may be missing; of what is damaged besides nothing is taken.
    """
    if not name:
        return packed, True
    if name not in CODECS:
        return b'', False
    try:
        whole = zstd.decompress(packed) if name == 'zstd' else lz4.frame.decompress(packed)
        return bytes(whole), True
    except DecompressError:
        stream = zstd.ZstdDecompressor() if name == 'zstd' else lz4.frame.LZ4FrameDecompressor()
    out = bytearray()
    try:
        for start in range(0, len(packed), piece):
            out += stream.decompress(packed[start : start + piece])
    except DecompressError:
        return b'' if cut_off else bytes(out), False
    return bytes(out), False


def plain_message(data: bytes) -> tuple[bytes, bool]:
    """A message, opened where its magic says that it was compressed by itself; is it all there."""
    return decompress('zstd', data) if data[: len(ZSTD_MAGIC)] == ZSTD_MAGIC else (data, True)


@contextmanager
def unpacked(file: Path) -> Iterator[Path]:
    """The file itself, or of one that is compressed as a whole (`.zstd`) a copy of its content."""
    if file.suffix != '.zstd':
        yield file
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, file.stem)
        with plain.open('wb') as target, suppress(*DecompressError):  # its end may be missing
            shutil.copyfileobj(zstd.open(file, 'rb'), target)
        yield plain
