"""Consensus-verified collaborative perception, as a library.

A frame is an ego's `Message` and its teammates'. A `Session` answers frame after frame with boxes, the teammates whose
messages are in them, and why the others are not; it remembers who was found to attack. `fuse` does the same for one
frame. `PGD` is an attack to try them with.

Examples
--------
>>> import numpy as np
>>> import robosac
>>> frame = robosac.IntersectionScene(seed=8).frame(0)
>>> detector = robosac.load_detector()
>>> messages = {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}
>>> ego = messages.pop("car-1")
>>> session = robosac.Session(detector, list(messages), rng=np.random.default_rng(0))
>>> session.answer(0, ego, messages).source
<Source.CONSENSUS: 'consensus'>
"""

from typing import TYPE_CHECKING

from robosac.lazy import lazily

if TYPE_CHECKING:
    from robosac.attacks import PGD
    from robosac.defenses import SampleConsensus
    from robosac.detectors import Message
    from robosac.detectors import load as load_detector
    from robosac.fusion import FusionResult, fuse
    from robosac.scenes import IntersectionScene
    from robosac.session import Session

    __version__: str
else:
    _find, __dir__ = lazily(
        __name__,
        {
            "FusionResult": "robosac.fusion:FusionResult",
            "IntersectionScene": "robosac.scenes:IntersectionScene",
            "Message": "robosac.detectors:Message",
            "PGD": "robosac.attacks:PGD",
            "SampleConsensus": "robosac.defenses:SampleConsensus",
            "Session": "robosac.session:Session",
            "fuse": "robosac.fusion:fuse",
            "load_detector": "robosac.detectors:load",
        },
    )

    def __getattr__(name: str) -> object:
        if name != "__version__":
            return _find(name)
        from importlib import metadata  # noqa: PLC0415 (it takes longer than all of this)

        return globals().setdefault(name, metadata.version(__name__))  # reading it takes milliseconds


__all__ = ["PGD", "FusionResult", "IntersectionScene", "Message", "SampleConsensus", "Session", "fuse", "load_detector"]
