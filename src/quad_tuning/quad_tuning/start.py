# PYTHON_ARGCOMPLETE_OK
"""The first lines of a command's process, before its imports, which take seconds."""

from __future__ import annotations

import signal

from quad_sysid.interrupt import take_over


def main() -> int:
    """`quad-tune …`."""
    take_over('quad-tune')
    from quad_tuning import cli

    return cli.main()


def ros2() -> int:
    """`ros2 run quad_tuning design …` and the others."""
    take_over('quad-tune')
    from quad_tuning import cli

    return cli.ros2()


def demo() -> int:
    """`ros2 run quad_tuning demo`, which stops the processes of its own by itself."""
    before = signal.getsignal(signal.SIGINT)
    take_over('demo')
    from quad_tuning.demo.main import main as run

    signal.signal(signal.SIGINT, before)
    return run()
