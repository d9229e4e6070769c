"""A field that follows the street: learnt from passes of pictures, kept if bits fall.

A *pass* is what one vehicle saw of a street in one drive: pictures and poses. ``run`` takes passes
under one light, fits all parameters of the field or a colour layer on it, and tries the result by
coding frames that it held back.
"""
