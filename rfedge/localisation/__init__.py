"""Searches for the poses of a drive whose poses are known: from wrong starts or a recorded feed."""
