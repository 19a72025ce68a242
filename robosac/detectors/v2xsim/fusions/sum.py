"""The sum of all maps."""

from __future__ import annotations

from collections.abc import Sequence

import torch


def fuse(maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """Maps (C, H, W), the ego's first, all in its frame -> their sum (C, H, W)."""
    return torch.stack(list(maps)).sum(dim=0)
