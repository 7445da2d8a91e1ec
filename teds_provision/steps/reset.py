"""Reset: a node back to factory state, and its signature under that (profile.md, "Reset")."""

from __future__ import annotations

import os
from dataclasses import dataclass

from teds_provision.errors import NotAuthentic
from teds_provision.protocol.keys import CHALLENGE_OCTETS, reset_message, verify
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station
from teds_provision.steps.agree import require_session
from teds_provision.steps.identify import Identified
from teds_provision.steps.read import read_identity
from teds_provision.talk.conversation import Conversation, SessionLost


@dataclass(frozen=True)
class ResetReceipt:
    """SIG(node, "TEDS1 reset" ‖ 00 ‖ UUID ‖ epoch ‖ challenge): the node says that it is in factory state."""

    epoch: int
    challenge: bytes
    proof: bytes


def reset_node(station: Station, node: Conversation, who: Identified) -> ResetReceipt:
    """Reset in a session; a node that is in factory state already gives the same proof plainly.

    The keys held for it are deleted only after the proof was verified. Raises PolicyRefused without a key,
    NotAuthentic where the proof is wrong.
    """
    if who.state != NodeState.FACTORY:
        require_session(station, node)
    receipt = proof_of_reset(node, who.point)
    with station.durable("reset"):
        station.keys.remove(who.uuid)
        station.nodes.remember(who.uuid, state=int(NodeState.FACTORY), retired=None)
        station.nodes.forget_reading(who.uuid)
        told = {"challenge": receipt.challenge.hex(), "proof": receipt.proof.hex()}
        station.audit("reset", who.uuid, "done", epoch=receipt.epoch, **told)
    return receipt


def proof_of_reset(node: Conversation, point: bytes) -> ResetReceipt:
    """Send Reset: in a session it resets, in factory state it changes nothing; either way the node signs its state.

    A node that has a key refuses it plainly (NodeRefused). Raises NotAuthentic where the signature is wrong.
    """
    epoch = read_identity(node).epoch
    challenge = os.urandom(CHALLENGE_OCTETS)
    command = security_command(Function.RESET, challenge)
    try:
        proof = node.send(command, "the reset")
    except SessionLost:  # its reply was lost and the session with it: in factory state it gives the proof again
        node.forget()
        proof = node.plain(command, "the proof of its reset")
    node.forget()
    if not verify(point, reset_message(node.uuid, epoch, challenge), proof):
        raise NotAuthentic("The node's receipt of the reset does not verify; its keys are kept here.")
    return ResetReceipt(epoch, challenge, proof)
