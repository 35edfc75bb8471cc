"""Shortest robot paths that keep a task constraint, by policy search on one learned manifold."""
