"""Localisation: the pose of a camera, from one picture and a radiance field.

``rfcore.localise.localiser`` is the search; it needs the extra ``localise`` (OpenCV), so the
services do not import this package when they start. ``rfcore.localise.estimate`` says where to
search and needs no extra. Import from the modules; nothing is re-exported.
"""
