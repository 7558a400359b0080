"""What a bag holds and what it can be used for, before anything is fitted."""

from quad_sysid.inspection.content import Content, content
from quad_sysid.inspection.page import lines, tree

__all__ = ['Content', 'content', 'lines', 'tree']
