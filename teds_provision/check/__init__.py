"""The rules of docs/profile.md and docs/operation.md, run against a board over its link: passed, failed or skipped.

==============  =======================================================================================
``rule``        what a rule is, when it can be run, the register, and how one ends
``probe``       the board as the rules see it: frames out, replies in, a record of both
``slips``       what firmware authors do in place of the right thing, tried until one fits
``plain_rules``       rules for any state, and those about the TEDS of a node
``firmware_rules``  rules of About, Locate and Manage
``link_rules``  rules of the link's own frames
``frame_rules``  rules of single CAN frames: addresses, ISO-TP, functional requests, Announce
``agreement_rules``   rules of factory state, of a node with a key, and of the key agreement; the test agreement
``session_rules``    Open, Sealed, Close; several stations; repetition; the CAN address
``write_rules``     Write, Update, the commit, Reset
``measuring_rules``  rules of boards with channels: claims, streams, Drive, trigger
``run``         which rules are run when, and what is made durable
==============  =======================================================================================
"""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.check import (
        agreement_rules,
        firmware_rules,
        frame_rules,
        link_rules,
        measuring_rules,
        plain_rules,
        probe,
        rule,
        run,
        session_rules,
        slips,
        write_rules,
    )
else:
    __getattr__ = lazy(__name__)
