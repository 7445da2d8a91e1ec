"""The firmware of a virtual node: two image slots in files, the boot loader's step, and an SMP server."""

from teds_provision.node.firmware import boot_loader

__all__ = ["boot_loader"]
