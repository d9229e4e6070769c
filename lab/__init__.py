"""Experiments, loads of several servers, city plans and recorded results of rfedge."""
