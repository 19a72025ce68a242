"""The largest value of all maps, at every place and channel."""

from __future__ import annotations

from collections.abc import Sequence

import torch


def fuse(maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """Maps (C, H, W), the ego's first, all in its frame -> their maximum (C, H, W)."""
    return torch.stack(list(maps)).amax(dim=0)
