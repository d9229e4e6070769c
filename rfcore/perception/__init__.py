"""Perception: what camera pictures show beyond a field: objects, their contacts with the ground,
and views composed of both."""
