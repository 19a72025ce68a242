"""How warped feature maps become one, by name. Each takes maps (C, H, W), the ego's first and all in its frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch


def mean(maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """The mean of all maps (C, H, W); places that a teammate does not see count as zero."""
    return torch.stack(list(maps)).mean(dim=0)


def largest(maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """The largest value of all maps at every place and channel (C, H, W)."""
    return torch.stack(list(maps)).amax(dim=0)


def total(maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """The sum of all maps (C, H, W)."""
    return torch.stack(list(maps)).sum(dim=0)


FUSIONS: Mapping[str, Callable[[Sequence[torch.Tensor]], torch.Tensor]] = {"mean": mean, "max": largest, "sum": total}
