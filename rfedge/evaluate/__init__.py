"""Experiments whose results are committed: a package each, with measuring, report and command.

The modules here are what several of them share: drives and clips (``clips``), our codec and its
rivals as coders of a clip (``field_coder``, ``rivals``), a coder's performance at the points that
span a window of quality (``performance``), kept piece by piece (``cells``), and what lies between
two of them (``rate_curve``).
"""
