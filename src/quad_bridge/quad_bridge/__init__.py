"""quad_bridge of the quad suite."""
