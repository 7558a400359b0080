"""What changed between flights or aircraft, parameter by parameter."""
