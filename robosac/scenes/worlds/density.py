"""How much traffic a world has, in a word that every layout knows."""

from __future__ import annotations

from typing import Literal

Density = Literal["sparse", "plain", "dense", "jammed"]
"""Jammed traffic is as dense as it can be and hardly moves."""
