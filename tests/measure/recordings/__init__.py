"""Recordings: read, told, converted."""
