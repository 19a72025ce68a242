"""What a detector lacks to be attacked, said before any work."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch

from robosac.attacks.base import Attack
from robosac.attacks.campaign import Campaign
from robosac.detectors.base import AttackSurface, Detector, Encoder, GeometricSurface, Preparer, blank
from robosac.plugins import lacks


def lacking(attack: Attack | Campaign | None, detector: Preparer) -> str | None:
    """Say what a detector lacks for scenes with an attack, before work begins.

    Parameters
    ----------
    attack : Attack, Campaign or None
        None for scenes without an attack.
    detector : Preparer
        Its attack surface is looked at in a frame of zeros.

    Returns
    -------
    str or None
        A sentence with each missing method and what it is for; None if nothing is missing.
    """
    campaign = Campaign.of(attack)
    name = detector.info.name
    if missing := lacks(detector, Encoder if campaign.attack is None else Detector):
        return f"the detector {name} cannot be used in scenes with the attack {campaign.name!r}: it {missing}"
    if campaign.attack is None or not isinstance(detector, Detector):
        return None
    if campaign.hears and detector.info.witness is None:
        return (
            f"{campaign.name} cannot attack the detector {name}: it reads testimony, and no witness lies beside the "
            "detector's weights (robosac witness makes one)"
        )
    surface = detector.attack_surface(blank(detector.info, "ego"), {"a": blank(detector.info, "teammate")})
    fault = lacks(surface, GeometricSurface, dict.fromkeys(campaign.needs)) or _surface_fault(surface, campaign.needs)
    return f"{campaign.name} cannot attack the detector {name}: its attack surface {fault}" if fault else None


def _surface_fault(surface: AttackSurface, needs: Collection[str]) -> str:
    """What a surface of one teammate gives in another form than an attack needs; empty if nothing."""
    messages: object = surface.messages
    if not isinstance(messages, Mapping):
        return f"has messages that are no mapping of teammates to tensors, but a {type(messages).__name__}"
    for name, message in messages.items():
        if not isinstance(message, torch.Tensor):
            return f"has messages that must be tensors; that of {name!r} is a {type(message).__name__}"
    logits: object = surface.class_logits(messages) if "class_logits" in needs else None
    if logits is not None and not isinstance(logits, torch.Tensor):
        return f"has class_logits that must return a tensor, got a {type(logits).__name__}"
    return ""
