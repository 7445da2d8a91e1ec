"""``ncap …``: the base station as a service."""
