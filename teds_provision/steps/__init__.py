"""Each step of provisioning: identify, whitelist, agree, build, sign, write, verify, provision, reset, address."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.steps import (
        address,
        agree,
        board_type,
        build,
        build_order,
        identify,
        inventory,
        judging,
        many,
        provision,
        read,
        reading,
        reset,
        sign,
        verify,
        verify_node,
        visits,
        whitelist,
        whitelist_files,
        write,
    )
else:
    __getattr__ = lazy(__name__)
