"""The node's end of a CAN bus."""
