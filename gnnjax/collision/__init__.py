"""Validity of configurations and edges, and the proof that a path is free."""
