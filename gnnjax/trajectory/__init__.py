"""From certified paths to motions in time."""
