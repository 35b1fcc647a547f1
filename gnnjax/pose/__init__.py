"""Poses: where the hand should be, and the configurations that put it there."""
