"""Identified models for other tools: python-control, MATLAB."""
