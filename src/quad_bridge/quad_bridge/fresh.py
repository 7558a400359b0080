"""Whether a command is recent enough. Pure.

What is played from a bag, waits in a queue or comes over a slow network was meant for another
moment: a command counts only with a stamp of just now.
"""

from __future__ import annotations

from quad_bridge.errors import RefusedError

OLDEST_S, AHEAD_S = 0.5, 0.1
"""The contract's: how old a command may be, and how far another computer's clock may be ahead."""


def stale(age_s: float) -> str:
    """Why a command that was stamped `age_s` ago does not count; empty where it does."""
    if -AHEAD_S <= age_s <= OLDEST_S:
        return ''
    age = f'{age_s:.1f} s old' if age_s > 0.0 else f'{-age_s:.1f} s ahead'
    remedy = 'stamp commands with the time of now, and set the clocks of all computers by NTP'
    most = f'at most {OLDEST_S:g} s old or {AHEAD_S:g} s ahead counts'
    return f'its stamp is {age}: {most}; {remedy}'


def refuse_stale(age_s: float) -> None:
    """Raise RefusedError where it does not count."""
    words = stale(age_s)
    if words:
        raise RefusedError(words)
