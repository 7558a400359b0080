# PYTHON_ARGCOMPLETE_OK
"""The first lines of a command's process, before its imports, which take seconds."""

from __future__ import annotations

from quad_sysid.interrupt import take_over


def main() -> int:
    """`quad-sysid …`."""
    take_over('quad-sysid')
    from quad_sysid import cli

    return cli.main()


def ros2() -> int:
    """`ros2 run quad_sysid identify …` and the others."""
    take_over('quad-sysid')
    from quad_sysid import cli

    return cli.ros2()
