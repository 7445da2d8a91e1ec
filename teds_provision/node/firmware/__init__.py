"""The firmware of a virtual node: two image slots in files, the boot loader's step, and an SMP server."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.node.firmware import boot_loader, manager
else:
    __getattr__ = lazy(__name__)
