"""Pictures of a gain design; nothing else in the design draws."""
