"""The line that an error of this project is: where, what, the value found, the remedy.

quad_sysid has it by a link, so nothing of ours is imported here.
"""

from __future__ import annotations

MAX_VALUE = 300
"""Characters of a value that a message shows; it may be a whole file."""


def one_line(where: str, what: str, value: object = None, remedy: str = '') -> str:
    """Return `<where>: <what>: found <value>; <remedy>`, without what is not given."""
    text = f'{where}: {what}'
    if value is not None:
        text += f': found {shortened(value)}'
    if remedy:
        text += f'; {remedy}'
    return ' '.join(text.split())


def shortened(value: object) -> str:
    """A value as one line of a message that stays readable."""
    text = ' '.join(str(value).split())
    if len(text) <= MAX_VALUE:
        return text
    return f'{text[:MAX_VALUE]} … ({len(text)} characters)'
