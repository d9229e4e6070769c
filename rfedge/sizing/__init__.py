"""Sizing of uplinks and processors, from measured tables."""
