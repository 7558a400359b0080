"""Identified models for other tools: python-control, MATLAB, JSON."""
