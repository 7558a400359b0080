"""Fit a structure to the training segments by the likelihood of its innovations."""
