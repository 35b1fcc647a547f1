"""Planners from elsewhere, to compare with."""
