"""The mean of all maps; places that a teammate does not see count as zero."""

from __future__ import annotations

from collections.abc import Sequence

import torch


def fuse(maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """Maps (C, H, W), the ego's first, all in its frame -> their mean (C, H, W)."""
    return torch.stack(list(maps)).mean(dim=0)
