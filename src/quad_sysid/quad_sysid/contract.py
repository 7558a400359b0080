"""What the contract fixes: axes, topics, the mixer. Plain tables and array maths, nothing else.

Source: the project's contract of topics, bags and commands (docs/reference/topics.md).
"""

from __future__ import annotations

from quad_sysid import topics
from quad_sysid.craft import AXES, FloatArray, X

TOPIC_TYPES = {name: kind for name, kind in topics.TOPIC_TYPES.items()
               if name != '/operator/enable'}
"""Topics that say something of a flight, as the operator's switch does not."""
STORAGE = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')
"""How the names of a bag's storage files end."""

MIXER, MIXER_INVERSE = X.mixer, X.inverse
"""(4, 4) each: m1..m4 = MIXER @ (U1..U4) of the X frame, and back; another craft has its own."""
motors_from_wrench, control_from_motors = X.commands, X.control
IDLE = 'mixer.idle'
"""Name in /gains/active of the smallest command of a motor in flight."""

__all__ = [
    'AXES',
    'IDLE',
    'MIXER',
    'MIXER_INVERSE',
    'STORAGE',
    'TOPIC_TYPES',
    'FloatArray',
    'control_from_motors',
    'motors_from_wrench',
]
