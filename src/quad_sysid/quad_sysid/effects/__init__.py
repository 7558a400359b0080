"""The effects that a base may lack: rows of tables and classes, in one list.

Other packages add theirs by the entry point group `quad_sysid.effects`: each entry is a sequence
of model.effect.Effect.
"""

from importlib.metadata import entry_points

from quad_sysid.effects.actuators import ACTUATORS
from quad_sysid.effects.curves import CURVES
from quad_sysid.effects.events import EVENTS
from quad_sysid.effects.hidden import HIDDEN
from quad_sysid.effects.torques import BY_LABEL, COUPLINGS, TORQUES
from quad_sysid.model.checked import checked
from quad_sysid.model.effect import Effect

GROUP = 'quad_sysid.effects'
BUILT_IN: tuple[Effect, ...] = (
    *TORQUES, *ACTUATORS, *COUPLINGS, *EVENTS, *HIDDEN, *CURVES,
)
BY_LABEL |= {effect.label: effect for effect in BUILT_IN}
EFFECTS: tuple[Effect, ...] = (
    *BUILT_IN,
    *(effect for entry in entry_points(group=GROUP)
      for effect in checked(entry.load(), f'entry point {entry.value}', BUILT_IN)),
)
"""The effects that `discover` compares, all under one prior."""

__all__ = ['EFFECTS']
