"""Searches on one roadmap; no network in sight."""
