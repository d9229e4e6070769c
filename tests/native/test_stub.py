"""``_native.pyi`` says what the compiled module has: names, members, parameters.

mypy's stubtest takes nanobind's functions for plain objects, so the comparison is made here, with
the signatures nanobind keeps (``__nb_signature__``).
"""

import ast
import re
from pathlib import Path
from typing import Any

import rfcore.native._native as native

STUB = ast.parse(Path(__file__).parents[2].joinpath("rfcore/native/_native.pyi").read_text())
Functions = dict[str, list[str]]


def stub_parameters(function: ast.FunctionDef) -> list[str]:
    named = function.args.kwonlyargs
    only_named = ["*", *(argument.arg for argument in named)] if named else []
    return [*(argument.arg for argument in function.args.args), *only_named]


def stub_functions() -> Functions:
    """Functions as ``name``, methods and properties as ``Class.name``."""
    found: Functions = {}
    for node in STUB.body:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = stub_parameters(node)
        if isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, ast.FunctionDef):
                    found[f"{node.name}.{member.name}"] = stub_parameters(member)
    return found


def native_parameters(function: Any) -> list[str]:
    (signature, *_), *_ = function.__nb_signature__
    inside = signature[signature.index("(") + 1 : signature.rindex(")")]
    flat = _without_brackets(inside)
    return [part.split(":")[0].split("=")[0].strip() for part in flat.split(",") if part.strip()]


def _without_brackets(text: str) -> str:
    """Remove what stands in brackets, innermost first: commas in there separate no parameters."""
    while (shorter := re.sub(r"\[[^\[\]]*\]|\([^()]*\)", "", text)) != text:
        text = shorter
    return text


def native_functions() -> Functions:
    found: Functions = {}
    for name, value in vars(native).items():
        if type(value).__name__ == "nb_func":
            found[name] = native_parameters(value)
        if type(value).__name__.startswith("nb_type"):
            for member, inner in vars(value).items():
                if isinstance(inner, property):
                    found[f"{name}.{member}"] = ["self"]
                elif type(inner).__name__ == "nb_method":
                    found[f"{name}.{member}"] = native_parameters(inner)
    return found


def test_the_stub_has_exactly_the_functions_and_parameters_of_the_module():
    assert stub_functions() == native_functions()


def test_signatures_with_nested_brackets_are_read():
    class Function:
        __nb_signature__ = (
            ("def f(self, a: list[tuple[int, int]], b: x(shape=(*, 3)) = 3)", None),
        )

    assert native_parameters(Function) == ["self", "a", "b"]
