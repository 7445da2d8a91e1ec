"""The steps of provisioning, one module each, and the commands composed of them."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.steps import (
        adoption,
        agree,
        batch,
        batch_sheet,
        board_type,
        build,
        calibration_guard,
        commands,
        datasheet_edit,
        firmware,
        identify,
        image_file,
        image_manager,
        inventory,
        provision,
        readings,
        sign,
        teds_read,
        update,
        verify,
        verify_files,
        verify_node,
        whitelist,
        write,
    )
else:
    __getattr__ = lazy(__name__)
