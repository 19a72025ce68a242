"""What a collaborative detector is to the rest of the project.

A detector turns a LiDAR scan into a *message*, and an ego's message with any subset of its teammates' into boxes in the
ego's frame. All that does not depend on the subset is done once per frame (`Detector.prepare`); each hypothesis then
costs one fusion and one decoder pass (`PreparedFrame.detect`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, cast, get_args, runtime_checkable

import numpy as np

from robosac.boxes import MOST_BOXES, FloatArray

if TYPE_CHECKING:
    import torch

    from robosac.testimony import Testimony

DEFAULT_DETECTOR = "intersection-mean"
"""Of those that ship, the one that is taken where none is named."""
Role = Literal["ego", "teammate"]
Precision = Literal["float32", "bfloat16", "float16"]
"""The numbers in which a decoder computes."""


@dataclass(frozen=True)
class TensorSpec:
    """Type and shape of one tensor of a message: a numpy dtype name, and C order."""

    dtype: str
    shape: tuple[int, ...]
    narrower: tuple[str, ...] = field(default=(), compare=False)
    """Other types that it may be sent in, see `robosac.detectors.narrow`."""

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor's data."""
        return int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize


class DetectorError(ValueError):
    """A detector gave something in another form than it has to."""


def check_boxes(boxes: object) -> FloatArray:
    """The boxes that ``detect`` returned.

    Raises
    ------
    DetectorError
        If they are no (n, 6) ndarray of finite numbers, more than `MOST_BOXES`, or a length or width is negative.
    """
    if not isinstance(boxes, np.ndarray):
        raise DetectorError(f"detect must return an array of boxes (n, 6), got a {type(boxes).__name__}")
    if boxes.ndim != 2 or boxes.shape[1] != 6:
        raise DetectorError(f"detect must return boxes (n, 6), got {boxes.shape}")
    if len(boxes) > MOST_BOXES:
        raise DetectorError(f"detect must return at most {MOST_BOXES} boxes, got {len(boxes)}: are they suppressed?")
    if boxes.dtype.kind not in "fiu" or not np.isfinite(boxes).all():
        raise DetectorError("detect must return finite numbers")
    if (boxes[:, 2:4] < 0).any():
        raise DetectorError(f"detect must return lengths and widths of 0 or more, got {boxes[:, 2:4].min():g}")
    return boxes


@dataclass(frozen=True)
class DetectorInfo:
    """A detector's public face."""

    name: str
    tensors: Mapping[Role, Mapping[str, TensorSpec]]
    """By role: what the ego and a teammate have to send."""
    area_m: tuple[float, float, float, float]
    """(xmin, ymin, xmax, ymax): where boxes are found, ego frame, metres."""
    cell_m: float
    """Edge of a feature cell, metres."""
    weights_digest: str
    """SHA-256 of the weights file, hexadecimal."""
    consensus_score: float
    """Boxes from this score on take part in the consensus test."""
    calibration: Path | None = None
    """The file of likelihoods for group testing that lies beside the weights."""
    witness: Path | None = None
    """The file of the network that reads single messages (`robosac.detectors.witness`), beside the weights too."""
    mirrored: bool = False
    """Whether columns of the maps in messages run along minus x."""
    precision: Precision = "float32"
    """The numbers in which fused maps are decoded. The name ends with ``@PRECISION``, unless that is float32."""
    device: str = field(default="cpu", compare=False)
    """Where it computes. It is the same detector wherever that is."""

    @property
    def narrower(self) -> dict[str, tuple[str, ...]]:
        """By tensor, the other types that it may be sent in; of those that have any."""
        specs = {name: spec for tensors in self.tensors.values() for name, spec in tensors.items()}
        return {name: spec.narrower for name, spec in specs.items() if spec.narrower}


def split_precision(name: str) -> tuple[str, Precision]:
    """``NAME@PRECISION`` as the name and the precision, float32 where none is named."""
    plain, _, last = name.rpartition("@")
    return (plain, cast(Precision, last)) if last in get_args(Precision) else (name, "float32")


def in_precision(info: DetectorInfo, precision: Precision) -> DetectorInfo:
    """The face of the same detector in another precision; `ValueError` for what is none."""
    if precision not in get_args(Precision):
        raise ValueError(f"precision must be one of {', '.join(get_args(Precision))}, got {precision!r}")
    plain, _ = split_precision(info.name)
    return replace(info, name=plain if precision == "float32" else f"{plain}@{precision}", precision=precision)


def calibration_beside(weights: Path) -> Path | None:
    """``NAME.calibration.json`` beside the weights ``NAME.safetensors``, if there is one."""
    path = weights.with_suffix(".calibration.json")
    return path if path.is_file() else None


def witness_beside(weights: Path) -> Path | None:
    """``NAME.witness.safetensors`` beside the weights ``NAME.safetensors``, if there is one."""
    path = weights.with_suffix(".witness.safetensors")
    return path if path.is_file() else None


@dataclass(frozen=True)
class Message:
    """What one vehicle shares in one frame."""

    pose: FloatArray
    """(4, 4) float64: world_from_sensor."""
    tensors: Mapping[str, np.ndarray[Any, np.dtype[Any]]]
    """By name: as the detector declares for the sender's role. In C order, whether made here or received."""


def for_role(message: Message, info: DetectorInfo, role: Role) -> Message:
    """The message with only those tensors that the detector wants from a sender in this role."""
    return Message(message.pose, {name: message.tensors[name] for name in info.tensors[role]})


def blank(info: DetectorInfo, role: Role) -> Message:
    """A message of zeros, as if sent from the origin by a vehicle in this role."""
    tensors = {name: np.zeros(spec.shape, dtype=spec.dtype) for name, spec in info.tensors[role].items()}
    return Message(np.eye(4), tensors)


def misfit(made: object, info: DetectorInfo) -> str | None:
    """What a message has to be for a detector, and what it is instead; None if it is of the layout of some role."""
    if not isinstance(made, Message):
        return f"a Message, got a {type(made).__name__}"
    for name, array in made.tensors.items():
        if not isinstance(array, np.ndarray):
            return f"numpy arrays; {name} is a {type(array).__name__}"
    held = {name: TensorSpec(array.dtype.name, array.shape) for name, array in made.tensors.items()}
    if any(wanted.items() <= held.items() for wanted in info.tensors.values()):
        return None
    wanted, got = (
        ", ".join(f"{name} of {spec.dtype} {list(spec.shape)}" for name, spec in specs.items())
        for specs in (info.tensors["ego"], held)
    )
    return f"a message with {wanted}, got {got or 'none'}"


class PreparedFrame(Protocol):
    """One frame, encoded and warped once, to be decoded for many subsets of teammates."""

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Fuse the ego with these teammates and decode.

        Returns
        -------
        (n, 6) float64 ndarray
            x, y, length, width, yaw, score; ego frame, best first. Empty subset: the ego's own perception.

        Raises
        ------
        KeyError
            If a teammate is not in the frame.
        """


class AttackSurface(Protocol):
    """A detector as a white-box attacker sees it: differentiable from messages to the ego's class logits."""

    @property
    def messages(self) -> Mapping[str, torch.Tensor]:
        """The benign messages of all teammates, float32, without batch dimension."""

    def class_logits(self, messages: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Class logits of the ego fused with these messages; with none, of the ego alone."""


@runtime_checkable
class GeometricSurface(AttackSurface, Protocol):
    """A surface that shows boxes too: what an attack needs that moves them, or leaves them where they are."""

    def perceive(self, messages: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Give the box of every class logit too.

        The ego is fused with these messages. Its places are all those where it might find a vehicle.

        Returns
        -------
        logits : tensor
            As `class_logits`.
        geometry : tensor of the same shape with six more numbers at the end
            The box that each logit stands for: x, y (ego frame, metres), log length, log width, cos and sin of twice
            the yaw.
        """


@runtime_checkable
class Growing(Protocol):
    """A prepared frame to which teammates may be added, or added again with another message."""

    def add(self, teammates: Mapping[str, Message]) -> None:
        """Do for these teammates what `Preparer.prepare` does, with the same result."""


@runtime_checkable
class Batching(Protocol):
    """A prepared frame that can decode several subsets at once."""

    @property
    def worth(self) -> int:
        """How many subsets are worth decoding at once; 1 where that takes as long as one after the other."""

    def detect_all(self, subsets: Sequence[Collection[str]]) -> list[FloatArray]:
        """What `PreparedFrame.detect` gives for each, but for rounding."""


@runtime_checkable
class Joining(Batching, Protocol):
    """A prepared frame whose subsets can be decoded at once with those of other frames."""

    @property
    def family(self) -> object:
        """Frames of the same one, and no others, can be decoded together."""

    def detect_together(self, wanted: Sequence[tuple[Any, Sequence[Collection[str]]]]) -> list[list[FloatArray]]:
        """What `Batching.detect_all` gives for each frame with its subsets. The frames are of this one's family."""


class Preparer(Protocol):
    """What fusion needs of a detector."""

    @property
    def info(self) -> DetectorInfo:
        """Name, message layout, area and digest."""

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:
        """Do once what all hypotheses of a frame share.

        The messages must already be checked against `info`.
        """


@runtime_checkable
class Testifying(Protocol):
    """What gives testimony of its own, in the place of the witness beside the weights: a recording does."""

    def testify(self, ego: Message, teammates: Mapping[str, Message]) -> Testimony | None:
        """What each message says by itself, the ego's under `robosac.defenses.EGO`; None if that is not known."""


@runtime_checkable
class Precise(Protocol):
    """What can decode in more than one precision."""

    def in_precision(self, precision: Precision) -> Self:
        """The same detector in another precision; it shares the weights.

        Raises
        ------
        ValueError
            If that is no precision.
        """


@runtime_checkable
class Placeable(Protocol):
    """What can compute on more than one device."""

    def on_device(self, device: str) -> Self:
        """The same detector on another device (`robosac.detectors.device.as_device`); nothing is shared that changes.

        Frames are prepared and decoded there. Scans are encoded, and attackers compute, on the processor.

        Raises
        ------
        ValueError
            If torch cannot compute there.
        """


class Encoder(Preparer, Protocol):
    """What scenes without an attack need of a detector."""

    def encode(self, points: FloatArray, pose: FloatArray) -> Message:
        """Make the message for a LiDAR scan.

        Parameters
        ----------
        points : (P, 3) ndarray
            Returns in the sensor's frame, metres.
        pose : (4, 4) ndarray
            world_from_sensor.

        Returns
        -------
        Message
            With all that an ego sends; `for_role` leaves what a teammate sends.
        """


@runtime_checkable
class Detector(Encoder, Protocol):
    """All that a collaborative detector can have: what scenes with an attack need of it.

    Implementations hold no state but their weights, and may be used from one thread at a time.
    """

    def attack_surface(self, ego: Message, teammates: Mapping[str, Message]) -> AttackSurface:
        """Show a frame to an attacker."""

    def perturbed(self, message: Message, tensor: torch.Tensor) -> Message:
        """Put an attacker's tensor, as in `AttackSurface.messages`, into a teammate's message."""
