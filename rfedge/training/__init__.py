"""Training of a field as users run it: views, memory, progress, checkpoints, and its report."""
