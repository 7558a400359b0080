"""System identification of a quadrotor's axes from flights: what the model lacks, and models.

    import quad_sysid as qs
    result = qs.identify('my_flight', axes='roll')      # verdict, effects, model, errors, rivals
    print(result); result.plot('missing_torque'); result.save('out')
    z = qs.detrend(qs.read_bag('my_flight').axis('roll', 'train'))
    model = qs.bj(z, 2, 2, 2, 2, 3)

Names and orders are MATLAB's; nk = 1 is one sample of delay. The names stand in __init__.pyi;
each is loaded when it is first used, so that the import costs nothing and needs neither ROS nor
matplotlib.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

_STUB = Path(__file__).with_name('__init__.pyi').read_text(encoding='utf-8')
_HOME_OF = {
    name.name: str(line.module) for line in ast.parse(_STUB).body
    if isinstance(line, ast.ImportFrom) for name in line.names
}


def __getattr__(name: str) -> object:
    """Load a public name from its home (PEP 562)."""
    if name == '__all__':
        return sorted(_HOME_OF)
    if name == '__version__':
        from importlib.metadata import version

        return version('quad-sysid')
    if name not in _HOME_OF:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({'__all__', *_HOME_OF, *(name for name in globals() if name.startswith('__'))})
