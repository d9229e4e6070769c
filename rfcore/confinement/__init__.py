"""Programs that read what others wrote: processes with no right but to compute and to answer."""
