"""Kernels: numeric functions in plain Python that are compiled when the package is built, and what calls them."""

from armsight.kernels.decorator import kernel, kernel_types

__all__ = ["kernel", "kernel_types"]
