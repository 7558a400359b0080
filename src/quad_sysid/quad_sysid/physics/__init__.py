"""The effects that a base may lack: one class a physics, one list of them all."""

from quad_sysid.physics.actuators import ACTUATORS
from quad_sysid.physics.couplings import COUPLINGS
from quad_sysid.physics.curves import CURVES
from quad_sysid.physics.events import EVENTS
from quad_sysid.physics.torques import TORQUES

EFFECTS = (*TORQUES, *ACTUATORS, *COUPLINGS, *EVENTS, *CURVES)
"""What `discover` compares: each pays the same price."""

__all__ = ['EFFECTS']
