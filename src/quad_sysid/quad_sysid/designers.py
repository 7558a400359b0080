"""Finds gain designers by entry point, so that quad_sysid does not import quad_tuning."""

from __future__ import annotations

from importlib.metadata import entry_points

from quad_sysid.model import Designer

GROUP = 'quad_sysid.designers'


def find_designer(name: str = 'pid') -> tuple[Designer | None, str]:
    """The designer of this name, or None and the reason."""
    found = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in found:
        offered = ', '.join(sorted(found)) or 'none'
        return None, (
            f'no designer {name!r} in the entry point group {GROUP} (offered: {offered}); '
            'install quad_tuning'
        )
    try:
        designer: Designer = found[name].load()
    except ImportError as error:
        return None, f'the designer {name!r} cannot be loaded: {error}'
    return designer, ''
