"""Writes config/policies.xml, the SROS2 policies of the nodes, from quad_bridge/topics.py.

`python tools/policies.py`, run by developers after a change of that table; a test holds the
committed file against it, and the table against what the nodes open.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from quad_bridge.topics import NODES, Opens

POLICIES = Path(__file__).resolve().parents[1] / 'src/quad_bridge/config/policies.xml'
PARAMETERS = (
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
    'set_parameters', 'set_parameters_atomically', 'get_type_description',
)  # fmt: skip
STATES = (
    'change_state', 'get_available_states', 'get_available_transitions', 'get_state',
    'get_transition_graph',
)  # fmt: skip
_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<!-- Generated from quad_bridge/topics.py by tools/policies.py: what each node may open.
     docs/secure.md says how to switch it on. -->
<policy version="0.2.0">
  <enclaves>
"""


def policies() -> str:
    """The file's text."""
    parts = [text for name, opens in NODES.items() for text in _enclave(name, opens)]
    return _HEAD + ''.join(f'    {line}\n' for line in parts) + '  </enclaves>\n</policy>\n'


def _enclave(name: str, opens: Opens) -> Iterable[str]:
    yield f'<enclave path="/{name}">'
    yield '  <profiles>'
    yield from _profile(name, opens)
    if name == 'serial_bridge':  # with log:=inside its process has the logger too
        yield from _profile('bag_logger', NODES['bag_logger'])
    yield '  </profiles>'
    yield '</enclave>'


def _profile(name: str, opens: Opens) -> Iterable[str]:
    """SROS2 puts the node's name for `~`, and its namespace before what begins with no `/`."""
    states = STATES if opens.managed else ()
    event = ('~/transition_event',) if opens.managed else ()
    own = (*PARAMETERS, *states, *opens.offers)
    yield f'    <profile ns="/" node="{name}">'
    yield from _rule('topic', 'publish', ('/rosout', '/parameter_events', *event),
                     opens.publishes)  # fmt: skip
    yield from _rule('topic', 'subscribe', ('/clock', '/parameter_events'), opens.hears)
    yield from _rule('service', 'reply', [f'~/{service}' for service in own])
    yield from _rule('service', 'request', (), opens.calls)
    yield '    </profile>'


def _rule(
    kind: str, what: str, names: Iterable[str], relative: Iterable[str] = ()
) -> Iterable[str]:
    every = [*names, *(name.removeprefix('/') for name in relative)]
    if every:
        yield f'      <{kind}s {what}="ALLOW">'
        yield from (f'        <{kind}>{name}</{kind}>' for name in every)
        yield f'      </{kind}s>'


if __name__ == '__main__':
    POLICIES.write_text(policies(), encoding='utf-8')
