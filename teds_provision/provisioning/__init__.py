"""One node, plain or in a session, and what is done with it: one module for each step of provisioning."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.provisioning import (
        address,
        adoption,
        agree,
        batch,
        batch_sheet,
        board_type,
        build,
        calibration_guard,
        charge,
        conversation,
        datasheet_edit,
        datasheet_history,
        firmware,
        identify,
        image_file,
        image_manager,
        inventory,
        locate,
        meeting,
        operator,
        parallel,
        progress,
        provision,
        read,
        readings,
        sign,
        teds_read,
        update,
        verify,
        verify_files,
        verify_node,
        visit,
        whitelist,
        write,
    )
else:
    __getattr__ = lazy(__name__)
