"""Confined processes for reading files of others: they may only compute and answer."""
