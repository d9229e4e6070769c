"""Building a scene's pictures on disk: in parallel, resumable, the same bytes for the same seed."""
