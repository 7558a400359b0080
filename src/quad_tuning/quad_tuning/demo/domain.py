"""A ROS domain of one's own, so that runs on one machine never hear each other."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator

PORT_BASE, PORT_GAIN, PORT_GUARD = 7400, 250, 249
"""Ports of a domain start at 7400 + 250 * domain (DDSI-RTPS 9.6.2.3); the last is our guard."""
DISCOVERY_OFFSETS = (0, 10, 12, 14)
"""Multicast, and unicast of the first three participants."""
LOWEST, HIGHEST = 1, 100
"""Above 101 the ports of Linux' own ephemeral range begin."""


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """A domain id that nobody on this machine uses, held until the block ends.

    Raises OSError where all of them are taken.
    """
    span = HIGHEST - LOWEST + 1
    first = os.getpid() % span
    for step in range(span):
        domain = LOWEST + (first + step) % span
        guard = _guard(domain)
        if guard is None:
            continue
        with guard:
            if not _in_use(domain):
                yield domain
                return
    raise OSError('no free ROS domain id between 1 and 100 on this machine')


def _guard(domain: int) -> socket.socket | None:
    guard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        guard.bind(('127.0.0.1', PORT_BASE + PORT_GAIN * domain + PORT_GUARD))
    except OSError:
        guard.close()
        return None
    return guard


def _in_use(domain: int) -> bool:
    """Whether somebody listens on one of the ports by which participants find each other."""
    for offset in DISCOVERY_OFFSETS:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', PORT_BASE + PORT_GAIN * domain + offset))
            except OSError:
                return True
    return False
