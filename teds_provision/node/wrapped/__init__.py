"""Wrapped sensors: a virtual node around a CAN message, a CANopen device or an IIO device (virtual-nodes.md)."""

from teds_provision.node.wrapped import description, reading, running, wrapped_source

__all__ = ["description", "reading", "running", "wrapped_source"]
