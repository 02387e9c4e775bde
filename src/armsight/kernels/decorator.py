"""The decorator of kernels: functions of numbers and arrays, written in Python, compiled when the package is built.

A kernel that Python calls names the types that it takes, as strings; one that only other kernels call names none:

    @kernel("f8[:, ::1], const f8[::1], i8")
    def scale(out: Array, factors: Array, count: int) -> float: ...

``b1`` is a boolean, ``i8 i4 i2 i1 u8 u4 u2 u1`` integers by their bytes, ``f8 f4`` floats. ``[:, :]`` is an array of
two dimensions, ``[:, ::1]`` one whose rows are contiguous, ``const`` one that is only read. A ``NamedTuple`` stands by its
name; :func:`kernel_types` says the types of its fields. Several strings are tried in their order.

Where the environment has ARMSIGHT_KERNELS=python the functions run as they stand: slow, but with a debugger, and the
oracle of what was compiled.
"""

from __future__ import annotations

import ast
import functools
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast, overload

import numpy as np

from armsight.errors import ArmsightError

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

#: The letters of numbers in a compiled signature (call.c), as numpy names them.
LETTERS = {
    "b": "?",
    "q": "i8",
    "i": "i4",
    "h": "i2",
    "c": "i1",
    "Q": "u8",
    "I": "u4",
    "H": "u2",
    "C": "u1",
    "d": "f8",
    "f": "f4",
}
#: What build.py sets, to collect the functions that it compiles: (function, signatures, options) -> its own.
builder: Callable[[Callable[..., Any], tuple[str, ...], dict[str, Any]], Any] | None = None
_PACKAGE = Path(__file__).resolve().parents[1]
_AGAIN = "build them: python -m pip install -e . in the checkout, or python -m armsight.kernels.build"


def in_python() -> bool:
    """Return whether kernels run as plain Python."""
    return os.environ.get("ARMSIGHT_KERNELS") == "python"


@functools.cache
def _library() -> Any:  # noqa: ANN401 - a compiled module has no types
    try:
        from armsight.kernels import _compiled  # type: ignore[attr-defined]
    except ImportError as error:
        raise ArmsightError(f"the compiled kernels are not there ({error}); {_AGAIN}") from None
    if (_PACKAGE.parents[1] / "setup.py").exists():  # a checkout; in an installed wheel nobody edits
        _check_not_stale(_compiled.sources())
    return _compiled


def _check_not_stale(sources: Iterable[tuple[str, str]]) -> None:
    """Check that files have the code that was compiled: all, as kernels contain those of other files that they call.

    ``sources``: names of modules, and the digests of their text and of their code, with a colon between.
    """
    for module, digest in sources:
        path = _PACKAGE.parent.joinpath(*module.split(".")).with_suffix(".py")
        text, _, code = digest.partition(":")
        if not path.exists() or (text_digest(path) != text and code_digest(path) != code):
            raise ArmsightError(f"{path} has changed since kernels were compiled; {_AGAIN}")


def text_digest(path: Path) -> str:
    """Return a digest of a source file's text."""
    return format(zlib.crc32(path.read_bytes().replace(b"\r\n", b"\n")), "08x")


def code_digest(path: Path) -> str:
    """Return a digest of a source file's code: comments, docstrings and layout leave it as it is."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node):
            del node.body[0]
    return format(zlib.crc32(ast.dump(tree).encode()), "08x")


def _array(data: bytearray, letter: str, shape: tuple[int, ...]) -> Any:  # noqa: ANN401
    return np.frombuffer(data, LETTERS[letter]).reshape(shape)


def _inner(function: Callable[P, R]) -> Callable[P, R]:
    """Return what stands for a kernel that only kernels call: an error, as Python is a thousand times slower."""

    @functools.wraps(function)
    def fail(*args: P.args, **kwargs: P.kwargs) -> R:
        raise TypeError(
            f"{function.__module__}.{function.__qualname__} has no signature: only kernels call it. Give its @kernel one "
            "to call it from Python"
        )

    return fail


def kernel_types(fields: str) -> Callable[[type[T]], type[T]]:
    """Say the types of a NamedTuple's fields, as in a kernel's signature."""

    def keep(record: type[T]) -> type[T]:
        record.kernel_types = fields  # type: ignore[attr-defined]
        return record

    return keep


@overload
def kernel(first: Callable[P, R]) -> Callable[P, R]: ...
@overload
def kernel(first: str, *signatures: str, **options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]: ...  # noqa: ANN401
@overload
def kernel(**options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]: ...  # noqa: ANN401


def kernel(first: Any = None, *signatures: str, **options: Any) -> Any:
    """Make a function a kernel; see the module's text for signatures.

    Args:
        first: the function, where neither signatures nor options are given; else the first signature.
        signatures: the others.
        options: ``nogil=True``: other threads of Python run meanwhile (not for kernels of some microseconds: to get the
            interpreter back takes longer). ``fastmath``, ``inline``, ``forceinline``: as numba defines them.

    Returns:
        What Python calls; arguments are positional, and their types are checked.
    """
    if callable(first):
        return kernel()(first)
    given = () if first is None else (first, *signatures)

    def wrap(function: Callable[P, R]) -> Callable[P, R]:
        if builder is not None:
            return cast("Callable[P, R]", builder(function, given, options))
        if in_python():
            return function
        if not given:
            return _inner(function)
        found = _library().find(function.__module__, function.__name__, _array)
        if found is None:
            raise ArmsightError(f"{function.__module__}.{function.__name__} is not compiled; {_AGAIN}")
        return cast("Callable[P, R]", functools.update_wrapper(found, function))

    return wrap
