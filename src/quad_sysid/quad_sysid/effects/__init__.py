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
from quad_sysid.errors import BadInputError
from quad_sysid.model.checked import checked
from quad_sysid.model.effect import Effect

GROUP = 'quad_sysid.effects'
BUILT_IN: tuple[Effect, ...] = (
    *TORQUES, *ACTUATORS, *COUPLINGS, *EVENTS, *HIDDEN, *CURVES,
)
BY_LABEL |= {effect.label: effect for effect in BUILT_IN}


def _installed() -> tuple[Effect, ...]:
    """The built-in effects and those of other packages; BadInputError for one that is none."""
    every = BUILT_IN
    for entry in entry_points(group=GROUP):
        where = f'entry point {entry.value}'
        try:
            loaded = entry.load()
        except Exception as error:
            raise BadInputError(where, 'cannot be loaded', f'{type(error).__name__}: {error}',
                                'mend its package or uninstall it') from error
        joined = (*every, *checked(loaded, where, every))
        every = checked(joined, where, joined)  # one name in two packages
    return every


EFFECTS: tuple[Effect, ...] = _installed()
"""The effects that `discover` compares, all under one prior."""

__all__ = ['EFFECTS']
