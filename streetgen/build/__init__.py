"""Build a scene's pictures on disk.

A build runs in parallel and goes on where it was stopped. The same seed gives the same bytes.
"""
