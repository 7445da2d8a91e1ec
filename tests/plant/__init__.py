"""Stations of one owner: documents, fold, registry."""
