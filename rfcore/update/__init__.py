"""Updates a field to changes of the street, from passes of vehicles, and keeps what saves bits.

A *pass* is the pictures and poses of one drive of one vehicle. ``run`` takes passes under one
light, fits all parameters of the field or a colour layer on it, and tests the result by coding
frames that it held back.
"""
