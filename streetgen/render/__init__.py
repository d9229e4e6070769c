"""Render a world with Mitsuba 3 and Open Image Denoise; no other package imports either.

Only the command that renders imports this package's modules, which need ``rfedge[scene]``.
"""
