"""The effects that a base may lack: one class a physics, one list of them all."""

from quad_sysid.effects.actuators import ACTUATORS
from quad_sysid.effects.couplings import COUPLINGS
from quad_sysid.effects.curves import CURVES
from quad_sysid.effects.events import EVENTS
from quad_sysid.effects.hidden import HIDDEN
from quad_sysid.effects.torques import TORQUES

EFFECTS = (*TORQUES, *ACTUATORS, *COUPLINGS, *EVENTS, *HIDDEN, *CURVES)
"""What `discover` compares: each pays the same price."""

__all__ = ['EFFECTS']
