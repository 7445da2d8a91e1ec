"""Commands that provision a node."""
