"""Rendering a world with Mitsuba 3 and Open Image Denoise; nothing else here knows either.

Only the verb that renders imports this package's modules, which need ``rfedge[scene]``.
"""
