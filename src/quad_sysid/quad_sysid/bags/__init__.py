"""Recorded data in and out: bags ↔ Record, foreign tables → bags."""

from quad_sysid.bags.reader import read_bag
from quad_sysid.bags.split import parse_span, split_segments
from quad_sysid.bags.writer import BagOptions, write_bag, write_streams

__all__ = [
    'BagOptions', 'parse_span', 'read_bag', 'split_segments', 'write_bag', 'write_streams',
]
