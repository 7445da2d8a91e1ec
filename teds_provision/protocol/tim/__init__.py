"""The node's half of the profile: every command, every state, every refusal. The reference for firmware authors.

Pure code, no I/O: a link server gives whole command frames and gets whole reply frames; flash, clock, randomness and
the hardware are injected. One :class:`Tim` serves all links of a node.

==================  ==================================================================================================
``node``            :class:`Tim`: routing, Identify, Prove, Reset, List
``permission``      the origin of a command, when each may be run, and what claims forbid
``node_sessions``   Open, Sealed, the lives of sessions
``node_agreement``  Request and Confirm
``teds_access``     Query, Read, Write, Update, and the commit
``manage``          About, Restart, Locate, and the packets of the image manager
==================  ==================================================================================================

Measuring and acting is ``protocol.operation`` (its ``role``, ``claims``, ``stream_role``, ``streams``); a node without
hardware to measure with leaves it out.
"""

from teds_provision.protocol.tim.node import Tim

__all__ = ["Tim"]
