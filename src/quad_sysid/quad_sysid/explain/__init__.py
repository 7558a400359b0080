"""From the model that predicts best to the causes that explain it."""

from quad_sysid.explain.ladder import Ladder, Rung, explain

__all__ = ['Ladder', 'Rung', 'explain']
