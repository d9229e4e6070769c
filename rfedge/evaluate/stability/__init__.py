"""The stability suite: hard cases, each with what is right and how it is judged."""

from rfedge.evaluate.stability.case import Case, Finding
from rfedge.evaluate.stability.registry import CASES

__all__ = ["CASES", "Case", "Finding"]
