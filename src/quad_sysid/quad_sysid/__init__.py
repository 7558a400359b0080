"""quad_sysid of the quad suite."""
