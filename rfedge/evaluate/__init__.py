"""Experiments: one package an experiment, results as immutable JSON."""
