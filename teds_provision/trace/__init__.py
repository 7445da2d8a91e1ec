"""Traces: the frames and messages of a link in a file, sealed ones with their opened form.

:func:`.recorder.open_trace` makes the file, :func:`.recorder.read_trace` reads it. Two forms, by the file's name:
``.pcapng`` (Wireshark opens it), else a line of JSON per frame or message. docs/trace.md describes both.
"""
