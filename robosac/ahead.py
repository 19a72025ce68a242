"""What of a frame can be worked out before all its messages are there.

What the ego sees alone depends on its own message. What a teammate's message says by itself, and where it lies in the
ego's frame, depends on that message and the ego's pose. So whoever waits for the last message can do that work
meanwhile. After it only fusions and their comparison are left. The answer is the same, to the last digit.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from robosac.boxes import FloatArray
from robosac.calibrated import witness_of
from robosac.defenses import EGO
from robosac.detectors import DetectorInfo, Message, PreparedFrame, Preparer
from robosac.detectors.base import Growing
from robosac.detectors.witness import Float16Array


class Ahead:
    """A frame of which the ego's message is there. It stands for the detector in that frame.

    Every method but `prepare` does work of at most about one pass. None has to be called.

    Parameters
    ----------
    detector : Preparer
    ego : Message
        Checked against the detector's layout, as all messages.

    Attributes
    ----------
    said : dict of agent to (LAYERS, H, W) ndarray
        What messages say by themselves (`robosac.detectors.witness.Witness.read_message`), as far as they were read;
        the ego's under `robosac.defenses.EGO`.
    alone : (n, 6) ndarray, optional
        What the ego perceives alone, if it is known.
    pass_s : float
        What the ego's own pass took, seconds; 0 before it.

    Examples
    --------
    >>> import robosac
    >>> from robosac.ahead import Ahead
    >>> detector = robosac.load_detector()
    >>> views = robosac.IntersectionScene(seed=8).frame(0).views
    >>> messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    >>> ego = messages.pop("car-1")
    >>> ahead = Ahead(detector, ego)
    >>> ahead.see_alone()
    >>> for name, message in messages.items():
    ...     ahead.lay(name, message)
    ...     ahead.read(name, message)
    >>> answer = robosac.Session(detector, list(messages)).answer(0, ego, messages, detector=ahead)
    """

    def __init__(self, detector: Preparer, ego: Message) -> None:
        self._detector = detector
        self._ego = ego
        self._prepared: PreparedFrame | None = None
        self._laid: dict[str, Message] = {}
        self._read: dict[str, Message] = {}
        self.alone: FloatArray | None = None
        self.said: dict[str, Float16Array] = {}
        self.pass_s = 0.0

    @property
    def info(self) -> DetectorInfo:
        """The detector's."""
        return self._detector.info

    def see_alone(self) -> None:
        """What the ego perceives alone."""
        started = time.perf_counter()
        self.alone = self._begun().detect(())
        self.pass_s = time.perf_counter() - started

    def lay(self, name: str, message: Message) -> None:
        """Lay a teammate's message over the ego's. Detectors that cannot add a teammate later do nothing."""
        prepared = self._begun()
        if isinstance(prepared, Growing):
            prepared.add({name: message})
            self._laid[name] = message

    def read(self, name: str, message: Message) -> None:
        """Ask the witness what a message says by itself; the ego's name is `robosac.defenses.EGO`."""
        witness = witness_of(self.info)
        if witness is not None:
            self.said[name] = witness.read_message(message)
            self._read[name] = message

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:
        """The frame with these teammates, whether they were laid before or not."""
        if ego is not self._ego:
            raise ValueError("another message of the ego was begun with")
        everybody = {EGO: ego, **teammates}
        for name in [name for name, message in self._read.items() if everybody.get(name) is not message]:
            del self.said[name], self._read[name]
        prepared = self._begun()
        if isinstance(prepared, Growing):
            prepared.add({name: each for name, each in teammates.items() if self._laid.get(name) is not each})
        elif teammates:
            prepared = self._detector.prepare(ego, teammates)
        return prepared

    def _begun(self) -> PreparedFrame:
        if self._prepared is None:
            self._prepared = self._detector.prepare(self._ego, {})
        return self._prepared
