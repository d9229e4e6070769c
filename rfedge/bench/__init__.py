"""Measurements: correctness first, then time, as JSON rows that others read."""

from rfedge.bench.results import CASES, print_rows, run_case, write_json

__all__ = ["CASES", "print_rows", "run_case", "write_json"]
