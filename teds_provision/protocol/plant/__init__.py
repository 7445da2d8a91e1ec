"""Documents that stations of one owner exchange, their proofs, and what follows from them (contract/plant.md).

``document`` signs and opens; ``roster``, ``page``, ``event`` and ``evidence`` are the contents. All pure: octets and
values in, values out; the clock and the store are the caller's.
"""
