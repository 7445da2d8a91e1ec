"""Commands about this base station."""
