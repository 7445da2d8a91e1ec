"""The whole story on one machine."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.demo import page, story
else:
    __getattr__ = lazy(__name__)
