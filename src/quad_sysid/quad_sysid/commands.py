"""One executable per command, for `ros2 run quad_sysid identify BAG` and the like."""

from __future__ import annotations

import sys

from quad_sysid.cli import main


def identify() -> int:
    """`ros2 run quad_sysid identify …`."""
    return main(['identify', *sys.argv[1:]])


def evaluate() -> int:
    """`ros2 run quad_sysid evaluate …`."""
    return main(['evaluate', *sys.argv[1:]])


def import_() -> int:
    """`ros2 run quad_sysid import …`."""
    return main(['import', *sys.argv[1:]])


def design_excitation() -> int:
    """`ros2 run quad_sysid design-excitation …`."""
    return main(['design-excitation', *sys.argv[1:]])


def inspect() -> int:
    """`ros2 run quad_sysid inspect …`."""
    return main(['inspect', *sys.argv[1:]])


def export() -> int:
    """`ros2 run quad_sysid export …`."""
    return main(['export', *sys.argv[1:]])


def compare() -> int:
    """`ros2 run quad_sysid compare …`."""
    return main(['compare', *sys.argv[1:]])


def fleet() -> int:
    """`ros2 run quad_sysid fleet …`."""
    return main(['fleet', *sys.argv[1:]])
