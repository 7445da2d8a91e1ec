"""The base station as a service (`ncap run`): what is on its links, what it measures, its API and its page.

==================  ========================================================================
module              what it does
==================  ========================================================================
``daemon``          begins and ends all of it, in order
``presence``        one daemon per home, and its Unix socket
``settings``        what it was started with
``roster``          what is known of every node, as the API shows it
``watching``        a thread for each link: nodes that come, nodes that leave
``looking``         one node that came: session, datasheet, verdict
``live``            values and events to many clients, none of which holds up another
``web/``            HTTP: the guard, tokens, routes
``page/``           the files of the page
==================  ========================================================================

Threads do what talks to nodes and to the disk; one event loop serves the clients. Nothing here writes keys, whitelist
or TEDS except through ``steps``.
"""
