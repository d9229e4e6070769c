"""Classes that users write and name on the command line, as ``MODULE:CLASS``."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from rfcore.errors import InvalidInput


def is_named_class(text: str) -> bool:
    """Return whether ``text`` has the form ``package.module:Class``."""
    module_name, _, class_name = text.partition(":")
    return class_name.isidentifier() and all(map(str.isidentifier, module_name.split(".")))


def make_named(option: str, text: str) -> object:
    """Return an instance of ``package.module:Class``, which is made without arguments.

    The module is one of the working folder or an installed one. Raises ``InvalidInput`` for
    ``option``, saying what was looked for.
    """
    if not is_named_class(text):
        raise InvalidInput(option, f"{text!r} is not MODULE:CLASS, as my_module:MyClass")
    module_name, _, class_name = text.partition(":")
    module = _imported(option, text, module_name)
    made = getattr(module, class_name, None)
    if made is None:
        where = getattr(module, "__file__", None) or "which is built in"
        raise InvalidInput(option, f"{text!r}: {module_name} ({where}) has no {class_name!r}")
    try:
        instance: object = made()
    except Exception as error:
        why = f"cannot be called without arguments: {error_in_a_line(error, text)}"
        raise InvalidInput(option, f"{text!r} {why}") from error
    return instance


def module_file(text: str) -> Path | None:
    """Return the file of the module of ``package.module:Class``, which was made; None without one.

    It is relative to the working folder if it is below that.
    """
    name = getattr(sys.modules.get(text.partition(":")[0]), "__file__", None)
    if name is None:
        return None
    here, path = Path.cwd(), Path(name)
    return path.relative_to(here) if path.is_relative_to(here) else path


def error_in_a_line(error: Exception, text: str) -> str:
    """Return class, message and place of an error; the place is where ``text``'s module was last.

    A class of a user fails in the user's own way: the line tells where to look.
    """
    said = " ".join(f"{type(error).__name__}: {error}".split())
    stack = traceback.extract_tb(error.__traceback__)
    file = getattr(sys.modules.get(text.partition(":")[0]), "__file__", None)
    own = [frame for frame in stack if frame.filename == file] or stack
    return f"{said} ({own[-1].filename}:{own[-1].lineno})" if own else said


def _imported(option: str, text: str, module_name: str) -> ModuleType:
    try:
        with _working_folder_on_path():
            return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module_name}.".startswith(f"{error.name}."):
            file = f"{module_name.replace('.', '/')}.py"
            why = f"there is neither {Path.cwd() / file} nor an installed module {module_name!r}"
            raise InvalidInput(option, f"{text!r}: {why}") from error
        raise InvalidInput(option, f"{text!r}: {module_name} needs {error.name!r}") from error
    except Exception as error:
        why = f"cannot be imported: {error_in_a_line(error, text)}"
        raise InvalidInput(option, f"{text!r} {why}") from error


@contextmanager
def _working_folder_on_path() -> Iterator[None]:
    """Let modules of the working folder be found, as ``python -m`` does, and no longer."""
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(folder)
