"""A device that is none: its tensors are kept on the processor, but refuse to meet those that are there.

It shows without an accelerator what would fail on one: tensors of two devices in one operation, and numbers that numpy
takes without fetching them. Unlike torch's fake tensors it computes, so answers can be compared.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import pytest
import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "elsewhere"


class There(torch.Tensor):
    """A tensor there; ``held`` has its numbers."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "There":
        like = {"dtype": held.dtype, "layout": held.layout, "storage_offset": held.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(cls, held.shape, strides=held.stride(), device=NAME, **like)
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


class Elsewhere(TorchDispatchMode):
    """While it is entered, tensors can be made there, or moved."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


def computed(func, args, kwargs):
    given = [each for each in tree_leaves((args, kwargs)) if isinstance(each, torch.Tensor)]
    there = [isinstance(each, There) for each in given]
    moves = func in (torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default)
    if not moves and any(there) and any(not each and of.dim() for each, of in zip(there, given, strict=True)):
        raise RuntimeError(f"{func}: some tensors are on the processor, and some {NAME}")
    target = kwargs.get("device")
    to_there = any(there) if target is None else torch.device(target).type == NAME
    held = {id(each.held): each for each in given if isinstance(each, There)}
    if target is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if func is torch.ops.aten._to_copy.default:  # always another tensor, as between devices
        kwargs = {**kwargs, "non_blocking": False}
    args, kwargs = tree_map(lambda each: each.held if isinstance(each, There) else each, (args, kwargs))
    result = func(*args, **kwargs)
    if not to_there:
        return result

    def taken(each):
        if not isinstance(each, torch.Tensor):
            return each
        return held[id(each)] if id(each) in held else There(each)  # what was changed in place is what it was

    return tree_map(taken, result)


@cache
def _known() -> None:
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch knows no devices that are written in Python")

    class Hidden(backend_registration._DummyBackendModule):
        """Nobody else is to find the device, as one would that looks for any accelerator."""

        def is_available(self):
            return False

    backend_registration._setup_privateuseone_for_python_backend(NAME, Hidden())


@contextmanager
def elsewhere() -> Iterator[str]:
    """The device's name, by which it is there for the length of a block."""
    _known()
    with Elsewhere():
        yield NAME
