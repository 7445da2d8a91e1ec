"""The nodes of the daemon.

Who is there (``watching``, ``directory``), what they are worth (``looking``), what is done with them (``desk``,
``sheets``, ``provisioning``, ``holding``), and those that it makes itself (``virtual``).
"""
