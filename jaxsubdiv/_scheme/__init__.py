"""Subdivision schemes, one a file."""
