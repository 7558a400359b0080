"""Compile what numba compiles of the virtual STM32, so that no first use waits (make build).

Short simulated flights call it in every way; no list of functions is kept here. The analysis has
`quad-sysid compile`.
"""

from __future__ import annotations

import numpy as np

from quad_bridge.virtual.process import prepared
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.simulation import fly

fly('demo_rig', [], 0.1, 1)
fly('demo_rig', [], 0.1, 1, effect=lambda *_: np.zeros(3))  # steps with a Python effect
prepared(Profile(), seed=1)  # the process' own steps
