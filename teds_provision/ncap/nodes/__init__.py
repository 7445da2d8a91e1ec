"""The nodes of the daemon.

Who is there (``link_watch``, ``directory``), what they are worth (``inspection``), what is done with them
(``node_jobs``, ``sheets``, ``provisioning``, ``actuator_leases``), and those that it makes itself (``virtual``).
"""
