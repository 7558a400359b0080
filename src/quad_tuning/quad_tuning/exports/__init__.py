"""Designed gains as parameter files of other flight controllers."""
