"""What went over a link, in a file: every frame as it went, every message with its name, sealed ones opened beside.

:func:`.recorder.open_trace` makes the file, :func:`.reading.read_trace` reads it. Two forms, by the file's name:
``.pcapng`` (Wireshark opens it), else a line of JSON per frame or message. docs/trace.md describes both.
"""
