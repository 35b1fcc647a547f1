"""Roadmaps: the graph, cheapest ways in it, and where its nodes come from."""
