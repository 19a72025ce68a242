"""How warped feature maps become one; one file a fusion, entered in `FUSIONS`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch

from robosac.detectors.v2xsim.fusions import max as largest
from robosac.detectors.v2xsim.fusions import mean
from robosac.detectors.v2xsim.fusions import sum as total

Fusion = Callable[[Sequence[torch.Tensor]], torch.Tensor]

FUSIONS: Mapping[str, Fusion] = {"mean": mean.fuse, "max": largest.fuse, "sum": total.fuse}

__all__ = ["FUSIONS", "Fusion"]
