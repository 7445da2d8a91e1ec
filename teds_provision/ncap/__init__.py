"""The base station as a service (`ncap run`): what is on its links, what it measures, its API and its page.

==========================  ========================================================================
module                      what it does
==========================  ========================================================================
``service_run``             from start to end: lock, socket, servers, signals
``settings``                what it was started with
``waits``                   how long it pauses between looks
``daemon``                  begins and ends all of its parts, in order
``measurement_supervisor``  what it measures, across restarts
``running_measurement``     one measurement: its nodes, their reports, its state
``membership``              which nodes join, wait and are tried again, decided without threads
``sinks``, ``names``        destinations of values, and their topics
``live``                    values and events to many clients, none of which holds up another
``nodes/``                  the nodes on its links, and what is done with them
``web/``                    HTTP: the guard, tokens, routes
``page/``                   the files of the page
==========================  ========================================================================

Threads do what talks to nodes and to the disk; one event loop serves the clients. Nothing here writes keys, whitelist
or TEDS except through ``provisioning``.
"""
