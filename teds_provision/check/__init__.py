"""The rules of docs/profile.md, run against somebody's board over its link: passed, failed or skipped, with the clause.

==============  =======================================================================================
``rule``        what a rule is, when it can be run, the register; ``outcome`` how one ends
``probe``       the board as the rules see it: frames out, replies in, a record of both
``plain``       rules for any state; ``teds_rules`` those about its TEDS
``link_rules``  rules of the link's own frames, which ``heard`` remembers
``owning``      rules of factory state, of a node with a key, and of the key agreement
``sessions``    Open, Sealed, Close
``writing``     Write, Update, the commit, Reset
``run``         which rules are run when, and what is made durable
==============  =======================================================================================
"""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.check import (
        heard,
        link_rules,
        outcome,
        owning,
        plain,
        probe,
        rule,
        run,
        sessions,
        teds_rules,
        writing,
    )
else:
    __getattr__ = lazy(__name__)
