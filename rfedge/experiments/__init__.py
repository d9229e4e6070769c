"""Experiments whose results are committed: a package each, with measuring, report and command.

The modules here are what several of them share: clips, coders, rate curves, finished cells.
"""
