"""HTTP: the guard in front of everything (``guard``, ``tokens``), the routes (``app`` and its parts), the servers.

Starlette, uvicorn and websockets come with the extra ``ncap``; only `ncap run` loads what is here.
"""
