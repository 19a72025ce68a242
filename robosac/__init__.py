"""Consensus-verified collaborative perception, as a library.

A frame is an ego's `Message` and its teammates'. `fuse` runs a defence against a detector and answers with boxes, the
teammates whose messages are in them, and why the others are not.

Examples
--------
>>> import numpy as np
>>> import robosac
>>> frame = robosac.IntersectionScene(seed=8).frame(0)
>>> detector = robosac.load_detector()
>>> messages = {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}
>>> ego = messages.pop("car-1")
>>> result = robosac.fuse(detector, robosac.SampleConsensus(), ego, messages, rng=np.random.default_rng(0))
>>> result.source
<Source.CONSENSUS: 'consensus'>
"""

from typing import TYPE_CHECKING

from robosac.lazy import lazily

if TYPE_CHECKING:
    from robosac.defenses import SampleConsensus
    from robosac.detectors import Message
    from robosac.detectors import load as load_detector
    from robosac.fusion import FusionResult, fuse
    from robosac.scenes import IntersectionScene
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "FusionResult": "robosac.fusion:FusionResult",
            "IntersectionScene": "robosac.scenes:IntersectionScene",
            "Message": "robosac.detectors:Message",
            "SampleConsensus": "robosac.defenses:SampleConsensus",
            "fuse": "robosac.fusion:fuse",
            "load_detector": "robosac.detectors:load",
        },
    )

__all__ = ["FusionResult", "IntersectionScene", "Message", "SampleConsensus", "fuse", "load_detector"]
