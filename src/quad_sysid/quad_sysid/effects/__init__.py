"""The effects that a base may lack: one class a physics, one list of them all.

Effects of other packages join it by the entry point group `quad_sysid.effects`: each entry is a
sequence of model.effect.Effect.
"""

from importlib.metadata import entry_points

from quad_sysid.effects.actuators import ACTUATORS
from quad_sysid.effects.couplings import COUPLINGS
from quad_sysid.effects.curves import CURVES
from quad_sysid.effects.events import EVENTS
from quad_sysid.effects.hidden import HIDDEN
from quad_sysid.effects.torques import TORQUES
from quad_sysid.model.effect import Effect

GROUP = 'quad_sysid.effects'
EFFECTS: tuple[Effect, ...] = (
    *TORQUES, *ACTUATORS, *COUPLINGS, *EVENTS, *HIDDEN, *CURVES,
    *(effect for entry in entry_points(group=GROUP) for effect in entry.load()),
)
"""What `discover` compares: each pays the same price."""

__all__ = ['EFFECTS']
