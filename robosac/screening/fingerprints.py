"""A message in few numbers: what it takes to tell repetitions and impossible sizes, without keeping maps.

A part of each tensor's values, drawn once for all, stands for the tensor. Its mean is removed, and random signs and
sums make a sketch of it whose inner products estimate those of the values (a count sketch: M. Charikar, K. Chen, M.
Farach-Colton, "Finding frequent items in data streams", 2002). The digest is linear modulo ``2 ** 64``: fast, and
enough to know a message again; it is no proof of anything against somebody who wants two messages to have the same.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from robosac.boxes import FloatArray, IntArray

VALUES = 2048
"""Of each tensor that are looked at; of a smaller one all."""
SKETCH = 128
"""Numbers in a sketch: correlations are estimated to within about .08."""
RIM = 8
"""The rim of a map is this part of its side."""
GLANCES = 24
"""So many places of a map tell of nearly all maps that they are not blank."""
FILLED = 0.2
"""A map with more of its places filled is not blank. Honest ones of the shipped detector have .42 and more of them
filled, and those of a scanner that is covered, or dying, .06 at most.
"""
_STEPS = 127
_BITS = {np.dtype(f"float{bits}"): bits for bits in (16, 32, 64)}

Tensor = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Fingerprint:
    """What is kept of a message."""

    digest: str
    """16 hexadecimal digits; the same bytes have the same."""
    blank: bool
    """Whether all tensors are the same nearly everywhere, see `_blank`, as those of a blind sensor are."""
    sizes: Mapping[str, tuple[float, float]]
    """By tensor: largest absolute value, and root mean square of the values that are looked at."""
    sketch: FloatArray
    """(`SKETCH`,) float64 of norm 1; zeros where there is nothing to compare."""


def fingerprints(messages: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Fingerprint]:
    """The fingerprints of a frame's messages.

    Parameters
    ----------
    messages : mapping of vehicle to mapping of name to ndarray
        All with the same tensors, of the same types and shapes.

    Returns
    -------
    dict of vehicle to Fingerprint
    """
    if not messages:
        return {}
    everybody = list(messages.values())
    digests, blank = [0] * len(messages), np.ones(len(messages), dtype=bool)
    largest: list[dict[str, float]] = [{} for _ in messages]
    rms: dict[str, FloatArray] = {}
    total = np.zeros((len(messages), SKETCH))
    for name in sorted(everybody[0]):
        shape, values, glanced = everybody[0][name].shape, [], []
        places, signs = _drawn(name, math.prod(shape))
        glances = _glances(name, shape)
        for i, tensors in enumerate(everybody):  # one after the other, while a tensor is in the processor's cache
            flat = np.ascontiguousarray(tensors[name]).reshape(-1)
            values.append(flat.take(places))
            glanced.append(flat.take(glances))
            words = _words(flat)
            digests[i] += int(np.einsum("i,i->", words, _weights(name, len(words))))
            largest[i][name] = _largest(flat)
        drawn = np.stack(values).astype(np.float64)
        blank &= _filled(np.stack(glanced)) <= 2 * FILLED  # well beyond what so few places may be off by
        for i in np.flatnonzero(blank).tolist():
            blank[i] = _blank(everybody[i][name])
        with np.errstate(over="ignore", invalid="ignore"):  # what is no number comes out as none
            rms[name] = np.sqrt(np.einsum("ij,ij->i", drawn, drawn) / max(drawn.shape[1], 1))
            total += _summed(drawn, signs)
    sketches = _coarse(np.where(blank[:, None], 0.0, total))
    return {
        vehicle: Fingerprint(
            f"{digests[i] % 2**64:016x}",
            bool(blank[i]),
            {name: (largest[i][name], float(of_all[i])) for name, of_all in rms.items()},
            sketches[i],
        )
        for i, vehicle in enumerate(messages)
    }


def likeness(one: FloatArray, other: FloatArray) -> float:
    """The correlation, in [-1, 1], of two messages by their sketches."""
    return float(one @ other)


def packed(sketches: FloatArray) -> list[str]:
    """Sketches (n, SKETCH) as text."""
    return [base64.b64encode(steps.tobytes()).decode() for steps in _steps(sketches)]


def unpacked(texts: Sequence[str]) -> FloatArray:
    """What `packed` made texts of, to the last bit."""
    steps = np.frombuffer(b"".join(base64.b64decode(text, validate=True) for text in texts), dtype=np.int8)
    return _of_norm_1(steps.reshape(-1, SKETCH).astype(np.float64))


def _blank(tensor: Tensor) -> bool:
    """Whether a map (..., H, W) has the same in nearly all places (`FILLED`), but for an eighth at each rim, where a
    network sees that map ends; or another array in all its values. Such a message says nothing of where its sender is:
    a scanner that is covered sees its cover, wherever it goes.
    """
    filled = float(_filled(_inside(tensor)))
    return filled <= FILLED if tensor.ndim >= 3 else not filled


def _filled(places: Tensor) -> FloatArray:
    """The share (...,) of places (..., channels, n) that are not as the first one, which is taken to be empty."""
    if not places.size:
        return np.zeros(places.shape[:-2])
    share: FloatArray = (places != places[..., :1]).any(axis=-2).mean(axis=-1)
    return share


def _inside(tensor: Tensor) -> Tensor:
    """The places (channels, n) within the rims."""
    if tensor.ndim < 3:
        return tensor.reshape(1, -1)
    rows, columns = (side // RIM for side in tensor.shape[-2:])
    inside = tensor[..., rows : tensor.shape[-2] - rows, columns : tensor.shape[-1] - columns]
    return inside.reshape(-1, math.prod(inside.shape[-2:]))


def _words(flat: Tensor) -> np.ndarray[Any, np.dtype[np.uint64]]:
    if flat.nbytes % 8 == 0:
        return flat.view(np.uint64)
    return np.frombuffer(flat.tobytes() + bytes(-flat.nbytes % 8), dtype=np.uint64)


def _largest(flat: Tensor) -> float:
    """The largest absolute value, without a copy of the values: numbers are ordered as their bits are."""
    if not len(flat):
        return 0.0
    bits = _BITS.get(flat.dtype)
    if bits is None:
        return float(np.abs(flat.astype(np.float64)).max())
    largest = int(flat.view(f"u{bits // 8}").max())
    if largest >> bits - 1:  # numbers below 0 count from the highest bit on
        largest = max(largest - (1 << bits - 1), int(flat.view(f"i{bits // 8}").max()))
    return float(np.array([largest], dtype=f"u{bits // 8}").view(flat.dtype)[0])


def _summed(values: FloatArray, signs: FloatArray) -> FloatArray:
    """The sketches (n, SKETCH) of some values (n, V), their mean removed and their norm 1."""
    if not values.shape[1]:
        return np.zeros((len(values), SKETCH))
    signed = _of_norm_1(values - values.mean(axis=1, keepdims=True)) * signs
    if over := -signed.shape[1] % SKETCH:
        signed = np.pad(signed, ((0, 0), (0, over)))
    summed: FloatArray = signed.reshape(len(values), -1, SKETCH).sum(axis=1)
    return summed


def _coarse(total: FloatArray) -> FloatArray:
    """Sketches (n, SKETCH) as `packed` keeps them, so that each is the same before and after."""
    total = np.where(np.isfinite(total).all(axis=1, keepdims=True), total, 0.0)
    return _of_norm_1(_steps(total).astype(np.float64))


def _steps(sketches: FloatArray) -> np.ndarray[Any, np.dtype[np.int8]]:
    most = np.abs(sketches).max(axis=-1, keepdims=True)
    steps: np.ndarray[Any, np.dtype[np.int8]] = np.round(sketches * (_STEPS / np.where(most > 0.0, most, 1.0))).astype(
        np.int8
    )
    return steps


def _of_norm_1(values: FloatArray) -> FloatArray:
    """Rows (n, V) of norm 1; those of zeros stay."""
    norms = np.sqrt(np.einsum("ij,ij->i", values, values))[:, None]
    scaled: FloatArray = values / np.where(norms > 0.0, norms, 1.0)
    return scaled


@lru_cache(maxsize=32)
def _weights(name: str, words: int) -> np.ndarray[Any, np.dtype[np.uint64]]:
    """Odd, so that a change of a single word always shows."""
    drawn = np.random.default_rng([zlib.crc32(name.encode()), words, 0]).integers(0, 2**64, words, dtype=np.uint64)
    return drawn | np.uint64(1)


@lru_cache(maxsize=32)
def _drawn(name: str, size: int) -> tuple[np.ndarray[Any, np.dtype[np.int64]], FloatArray]:
    """Which values are looked at, and the sign that each has in the sketch."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), size, 1])
    places = np.sort(rng.choice(size, min(size, VALUES), replace=False)) if size else np.zeros(0, dtype=np.int64)
    return places, rng.choice([-1.0, 1.0], len(places))


@lru_cache(maxsize=32)
def _glances(name: str, shape: tuple[int, ...]) -> IntArray:
    """Where the first of the places (channels, n) within the rims is in the tensor, and some others."""
    size = math.prod(shape)
    inside: IntArray = _inside(np.arange(size).reshape(shape))
    drawn = np.random.default_rng([zlib.crc32(name.encode()), size, 2]).permutation(inside.shape[1])[:GLANCES]
    return inside[:, np.union1d(np.arange(inside.shape[1])[:1], drawn)]
