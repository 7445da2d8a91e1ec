"""The commands of an owner's plant and of its production line."""
