"""The commands of the base station as a service."""
