"""Zstandard: Python 3.14 has it, before that the backport that rosbags brings along."""

from __future__ import annotations

import sys

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor, ZstdError, decompress
else:
    from backports.zstd import ZstdDecompressor, ZstdError, decompress

__all__ = ['ZstdDecompressor', 'ZstdError', 'decompress']
