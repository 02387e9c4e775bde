"""Kernels: numeric functions in plain Python that are compiled when the package is built, and what calls them."""

from armsight.kernels.decorator import kernel

__all__ = ["kernel"]
