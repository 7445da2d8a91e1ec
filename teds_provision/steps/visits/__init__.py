"""Each command at a node as one call: a meeting with it, and the steps that the command is made of."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.steps.visits import at_node, history, identify_at, sheet_file, sign_command, visit
else:
    __getattr__ = lazy(__name__)
