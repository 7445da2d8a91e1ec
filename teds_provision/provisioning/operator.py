"""A person's answers while nodes are provisioned: one object that goes from the command or service to each step.

Each method is a question. It returns for a yes and raises for a no, so a step asks by calling it.
"""

from __future__ import annotations

from teds_provision.errors import NotWhitelistedError, PolicyError
from teds_provision.provisioning.adoption import FactoryDatasheet, refuse_adoption
from teds_provision.provisioning.board_type import require_board_type
from teds_provision.provisioning.build import no_confirmation
from teds_provision.provisioning.charge import wait_for_charge
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.teds.diff import Change


class Operator:
    """No operator is present: everything that needs a confirmation is refused."""

    def accept(self, who: IdentifiedNode) -> None:
        """Ask before an unknown node is whitelisted; raises NotWhitelistedError."""
        raise NotWhitelistedError(
            f"Node {who.uuid.hex()} is not on the whitelist.",
            hint=f"teds-provision whitelist add {who.uuid.hex()} --fingerprint {who.fingerprint}",
        )

    def take_over(self, question: str, refusal: PolicyError) -> None:
        """Ask before a node with another station's key gets one of ours, which locks that station out.

        Raises ``refusal`` if no person can be asked.
        """
        raise refusal

    def retype(self, uuid: bytes, differences: tuple[str, ...]) -> None:
        """Ask before a board becomes one of another type than it claims; raises WrongBoardError."""
        require_board_type(uuid, differences)

    def confirm(self, uuid: bytes, changes: tuple[Change, ...]) -> None:
        """Ask before a datasheet changes in what the order does not name; raises UnrequestedChangeError."""
        no_confirmation(uuid, changes)

    def adopt(self, brought: FactoryDatasheet) -> None:
        """Ask before a datasheet that the board brought itself is signed; raises NotAdoptedError."""
        refuse_adoption(brought)

    def low_battery(self, question: str) -> None:
        """Ask before a node with a low battery is written; raises PolicyError."""
        wait_for_charge(question)

    def jump(self, question: str) -> None:
        """Ask before a datasheet is written that uses up many sequence numbers of its node; raises PolicyError."""
        raise PolicyError("This needs confirmation, but no person can be asked.", hint=question)


class AcceptingOperator(Operator):
    """The caller named the board or accepts any: it is whitelisted. Everything else is refused."""

    def accept(self, who: IdentifiedNode) -> None:
        """Return for every board."""
