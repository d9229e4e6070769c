"""Training of radiance fields from posed pictures."""
