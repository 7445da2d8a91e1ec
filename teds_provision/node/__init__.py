"""The virtual transducer: flash in a file, TIM server, both links."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.node import (
        can,
        firmware,
        flash_file,
        handler,
        hardware,
        nfc,
        node_template,
        realtime_loop,
        sources,
        virtual,
        wrapped,
    )
else:
    __getattr__ = lazy(__name__)
