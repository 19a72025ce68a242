"""The V2X-Sim detector: published architecture, weights brought along by the user."""

from robosac.detectors.v2xsim.detector import V2XSimDetector, write_weights

__all__ = ["V2XSimDetector", "write_weights"]
