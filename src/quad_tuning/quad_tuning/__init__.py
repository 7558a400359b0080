"""quad_tuning of the quad suite."""
