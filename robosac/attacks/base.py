"""White-box attacks on messages: one loop, and hooks that make its members.

An attacker v replaces its message M_v by M_v + delta, with ``max |delta| <= epsilon``, to spoil what the ego detects.
Several attackers are optimised jointly. The attack acts on the message as it is sent, before the ego warps it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch.nn import functional

from robosac.arguments import check_rng
from robosac.attacks.returned import check_aim, check_prepared, of_attackers
from robosac.attacks.situation import Situation
from robosac.detectors.base import AttackSurface

SEEN = 0.1
"""A place with a class score from here on counts as one where something is seen."""
Tensors = Mapping[str, torch.Tensor]
Aim = Callable[[Tensors, Tensors], torch.Tensor]
"""What the adversary minimises: of the attackers' present messages and their perturbations."""
Term = Callable[[Tensors], torch.Tensor]
"""What is added to that, of the attackers' present messages."""
_VARIABLES = "variables"


class Optimiser(Protocol):
    """What moves variables along their ``grad``, as those of `torch.optim` do."""

    def step(self) -> object:
        """Move them once."""


@dataclass(frozen=True)
class Descent:
    """Plain descent. `torch.optim.SGD` does the same, but loads all of torch's compiler, which takes seconds."""

    variables: Sequence[torch.Tensor]
    step_size: float

    @torch.no_grad()
    def step(self) -> None:
        """Subtract ``step_size * grad`` from each variable."""
        for variable in self.variables:
            assert variable.grad is not None
            variable.sub_(variable.grad, alpha=self.step_size)


@dataclass(frozen=True)
class Knowledge:
    """What the adversary sees before it begins."""

    ego_logits: torch.Tensor
    """Class logits of the ego alone: the paper's pseudo ground truth."""
    benign_logits: torch.Tensor
    """Class logits of the fusion in which everybody is honest."""


@dataclass(frozen=True)
class Attack(ABC):
    """An adversary in control of some teammates.

    Raises
    ------
    ValueError
        If a parameter that is a number is none, not positive or infinite, or one that counts is not whole; or if
        ``needs`` is a text in the place of a tuple.
    """

    name: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    """What the attack calls of an attack surface, besides its ``messages``."""
    remembers: ClassVar[bool] = False
    """Whether it goes by earlier frames, too: then it is run over the frames of a sequence in order."""
    hears: ClassVar[bool] = False
    """Whether it reads what each message says by itself: then it needs a detector with a witness."""
    bounded: ClassVar[bool] = True
    """Whether messages keep within ``epsilon`` of the benign ones."""

    epsilon: float = 0.5
    """L-infinity bound on the perturbation, in units of the message."""

    def __post_init__(self) -> None:
        if isinstance(self.needs, str):
            raise ValueError(f"needs must be a tuple of names, such as ({self.needs!r},), not a text")
        for parameter in fields(self):
            name, value = parameter.name, getattr(self, parameter.name)
            kind = getattr(parameter.type, "__name__", parameter.type)  # a text where annotations are not evaluated
            is_number = isinstance(value, Real) and not isinstance(value, bool)
            if kind == "int" and not (is_number and isinstance(value, Integral)):
                raise ValueError(f"{name} must be a whole number, got {value!r}")
            if kind == "float" and not is_number:
                raise ValueError(f"{name} must be a number, got {value!r}")
            if is_number and not 0 < float(value) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")

    @abstractmethod
    def run(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        rng: np.random.Generator,
        situation: Situation | None = None,
    ) -> dict[str, torch.Tensor]:
        """Make the attackers' messages.

        Parameters
        ----------
        surface : AttackSurface
            The frame with everybody's benign message.
        attackers : collection of str
            Teammates under the adversary's control.
        rng : numpy.random.Generator
            For all that is random about the attack.
        situation : Situation, optional
            The frame's number, poses, true boxes and past; by default a first frame of which nothing else is known.

        Returns
        -------
        mapping of attacker to tensor
            The messages to send instead, of the shape of the benign ones. Who is missing sends its benign one.

        Raises
        ------
        robosac.attacks.returned.NoSuchAttacker
            A `KeyError`: an attacker has no message in the frame.
        """


@dataclass(frozen=True)
class IterativeAttack(Attack):
    """Descend an objective for a number of steps, staying within the bound.

    The bound holds around the messages that `around` gives.

    1. ``variables = start()``.
    2. Repeat ``steps`` times: the optimiser moves the variables along ``normalise(gradient of objective)``; then
       ``variables = project(variables)``.
    3. The perturbation is ``perturbation(variables)``.

    Parameters
    ----------
    steps : int
        At least 1.
    step_size : float
        The optimiser's; for signed steps, in units of the message.
    """

    needs: ClassVar[tuple[str, ...]] = ("class_logits",)

    steps: int = 15
    step_size: float = 0.1

    def run(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        rng: np.random.Generator,
        situation: Situation | None = None,
    ) -> dict[str, torch.Tensor]:
        """Optimise the attackers' messages jointly."""
        check_rng(rng)
        return self.optimise(surface, attackers, rng, situation or Situation(), warm=self.remembers)

    def optimise(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        rng: np.random.Generator,
        situation: Situation,
        terms: Sequence[Term] = (),
        warm: bool = False,
    ) -> dict[str, torch.Tensor]:
        """Optimise the attackers' messages jointly for the attack's aim and further terms.

        Parameters
        ----------
        terms : sequence of Term
            Are added to the aim.
        warm : bool
            Whether to begin with the variables that the frame before ended with, and to keep those of this frame.
        """
        clean = self.around(surface, attackers, situation)
        if not clean:
            return {}
        attacking = self.prepare(surface, clean, rng, situation)
        check_prepared(getattr(self, "name", type(self).__name__), attacking)
        if not attacking:
            return {}
        harm = self.aim(surface, clean, situation)

        def aim(sent: Tensors, delta: Tensors) -> torch.Tensor:
            added = [term(sent) for term in terms]
            return sum(added, harm(sent, delta))

        start = self.start(clean, rng)
        if warm:
            kept: Tensors = situation.memory.get(_VARIABLES, {})
            start |= {n: kept[n].clone() for n in clean if n in kept and kept[n].shape == clean[n].shape}
        end = self.descend(aim, start, clean)
        if warm:
            situation.memory[_VARIABLES] = {n: variable.detach() for n, variable in end.items()}
        return {name: (clean[name] + self.perturbation(variable)).detach() for name, variable in end.items()}

    def descend(self, aim: Aim, start: Tensors, clean: Tensors) -> Tensors:
        """The loop: from these variables to such at which the aim is small, the messages within the bound around these
        clean ones.
        """
        variables = {name: v.requires_grad_(True) for name, v in start.items()}
        optimiser = self.optimiser(list(variables.values()))
        for _ in range(self.steps):
            delta = {name: self.perturbation(v) for name, v in variables.items()}
            attacked = {name: clean[name] + d for name, d in delta.items()}
            value = aim(attacked, delta)
            check_aim(getattr(self, "name", type(self).__name__), value)
            gradients = torch.autograd.grad(value, list(variables.values()))
            with torch.no_grad():
                for variable, gradient in zip(variables.values(), gradients, strict=True):
                    variable.grad = self.normalise(gradient)
                optimiser.step()
                for variable in variables.values():
                    variable.copy_(self.project(variable))
        return variables

    def around(
        self,
        surface: AttackSurface,
        attackers: Collection[str],
        situation: Situation,  # noqa: ARG002
    ) -> dict[str, torch.Tensor]:
        """What perturbations are added to; by default the attackers' benign messages. Who is missing is honest."""
        return of_attackers(surface.messages, attackers)

    def prepare(
        self,
        surface: AttackSurface,  # noqa: ARG002
        attackers: Collection[str],  # noqa: ARG002
        rng: np.random.Generator,  # noqa: ARG002
        situation: Situation,  # noqa: ARG002
    ) -> bool:
        """What is settled before the aim, as what to lie about. If it returns False, all are honest in this frame."""
        return True

    def start(self, clean: Tensors, rng: np.random.Generator) -> dict[str, torch.Tensor]:  # noqa: ARG002
        """The first variables, within the bound; by default those of no perturbation."""
        return {name: torch.zeros_like(tensor) for name, tensor in clean.items()}

    def aim(self, surface: AttackSurface, attackers: Collection[str], situation: Situation) -> Aim:  # noqa: ARG002
        """What the adversary minimises in this frame; by default `objective` of the class logits of the whole team."""
        with torch.no_grad():
            known = Knowledge(surface.class_logits({}), surface.class_logits(surface.messages))

        def loss(sent: Tensors, delta: Tensors) -> torch.Tensor:
            return self.objective(known, surface.class_logits({**surface.messages, **sent}), delta)

        return loss

    def objective(self, known: Knowledge, logits: torch.Tensor, delta: Tensors) -> torch.Tensor:  # noqa: ARG002
        """What the adversary minimises; by default the paper's loss.

        There the ego-only class scores stand for the unknown truth, and the attacker wants each of them inverted:
        objects erased and background filled. The loss is the mean binary cross-entropy against ``1 -
        sigmoid(known.ego_logits)``.

        Parameters
        ----------
        known : Knowledge
            From before the attack.
        logits : tensor
            The ego's class logits under the present perturbation.
        delta : mapping of attacker to tensor
            The present perturbation.
        """
        return functional.binary_cross_entropy_with_logits(logits, 1.0 - torch.sigmoid(known.ego_logits))

    def perturbation(self, variable: torch.Tensor) -> torch.Tensor:
        """The perturbation that a variable stands for; by default itself."""
        return variable

    def optimiser(self, variables: list[torch.Tensor]) -> Optimiser:
        """What moves the variables; by default plain descent."""
        return Descent(variables, self.step_size)

    def normalise(self, gradient: torch.Tensor) -> torch.Tensor:
        """The direction of a step; by default the sign, the steepest descent under an L-infinity bound."""
        return gradient.sign()

    def project(self, variable: torch.Tensor) -> torch.Tensor:
        """The nearest variable within the bound."""
        return variable.clamp(-self.epsilon, self.epsilon)
