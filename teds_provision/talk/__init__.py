"""One node, plain or sealed: conversation, sessions; meeting one node, all of a bus, or one after the other."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.talk import conversation, meeting, progress
else:
    __getattr__ = lazy(__name__)
