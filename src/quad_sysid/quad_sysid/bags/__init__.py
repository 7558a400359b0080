"""Recorded data in and out: bags ↔ Record, foreign tables → bags."""

from quad_sysid.bags.reader import read_bag
from quad_sysid.bags.split import parse_span, split_segments

__all__ = ['parse_span', 'read_bag', 'split_segments']
