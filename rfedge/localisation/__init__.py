"""Tries of the localiser on a drive whose poses are known: starts, sensors, report."""
