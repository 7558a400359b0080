"""Recorded data in and out: bags ↔ Record."""

from quad_sysid.bags.reader import read_bag
from quad_sysid.bags.split import clip_span, parse_span, split_segments
from quad_sysid.bags.writer import BagOptions, write_bag, write_streams

__all__ = ['BagOptions', 'clip_span', 'parse_span', 'read_bag', 'split_segments', 'write_bag',
           'write_streams']
