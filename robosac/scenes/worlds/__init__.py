"""Several kinds of generated worlds, each a scene source: ``world:NAME``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

from robosac.scenes.base import Scene, SceneError, Split
from robosac.scenes.splits import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from robosac.scenes.worlds.table import WORLDS, Recipe

__all__ = ["WORLDS", "Recipe", "World"]


@dataclass(frozen=True)
class _Scenes(Sequence[Scene]):
    """The scenes of a row of seeds, each made when it is asked for."""

    recipe: Recipe
    seeds: range

    def __len__(self) -> int:
        return len(self.seeds)

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Scene]: ...
    def __getitem__(self, index: int | slice) -> Scene | Sequence[Scene]:
        if isinstance(index, slice):
            return _Scenes(self.recipe, self.seeds[index])
        return self.recipe.scene(self.seeds[index])

    def __iter__(self) -> Iterator[Scene]:
        return map(self.recipe.scene, self.seeds)


class World:
    """Scenes of one of the `WORLDS`; those of one purpose serve no other.

    Parameters
    ----------
    name : str
        Of `WORLDS`.

    Raises
    ------
    SceneError
        If there is no such world; it lists those that there are.
    """

    kind = "world"

    def __init__(self, name: str = "") -> None:
        if name not in WORLDS:
            raise SceneError(f"no world {name!r}: there are {', '.join(WORLDS)}")
        self.name = f"{self.kind}:{name}"
        self._recipe = WORLDS[name]

    def scenes(self, split: Split) -> Sequence[Scene]:
        """A thousand scenes."""
        return _Scenes(self._recipe, TEST_SEEDS if split == "test" else VALIDATION_SEEDS)

    def training_scenes(self) -> Sequence[Scene]:
        """Almost a million more, to train on."""
        return _Scenes(self._recipe, TRAINING_SEEDS)

    def scene(self, seed: int) -> Scene:
        """The scene of any seed; `robosac.scenes.splits` says which seeds serve what.

        Raises
        ------
        SceneError
            If the seed is negative.
        """
        if seed < 0:
            raise SceneError(f"a seed must not be negative, got {seed}")
        return self._recipe.scene(seed)
