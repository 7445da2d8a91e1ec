"""One node, plain or sealed: conversation, sessions, meeting, watching."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.talk import conversation, meeting, progress, watching
else:
    __getattr__ = lazy(__name__)
