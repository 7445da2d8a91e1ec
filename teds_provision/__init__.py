"""Provision smart transducers: identify, whitelist, key, sign and write their IEEE 1451.0 datasheets."""

__version__ = "0.3.0.dev0"
