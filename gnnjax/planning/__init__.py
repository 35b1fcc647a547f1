"""From a query to a certified path."""
