"""A viewer in the browser: queries that are planned anew while they are edited."""
