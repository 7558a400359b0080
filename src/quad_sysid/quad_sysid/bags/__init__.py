"""Recorded data in and out: bags ↔ Record, foreign tables → bags."""

from quad_sysid.bags.importer import ImportOptions, import_csv, parse_units
from quad_sysid.bags.reader import read_bag
from quad_sysid.bags.split import clip_span, parse_span, split_segments
from quad_sysid.bags.writer import BagOptions, write_bag, write_streams

__all__ = [
    'BagOptions', 'ImportOptions', 'clip_span', 'import_csv', 'parse_span', 'parse_units',
    'read_bag', 'split_segments', 'write_bag', 'write_streams',
]
