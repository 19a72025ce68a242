"""The V2X-Sim detector: published architecture, weights brought along by the user."""

from robosac.detectors.v2xsim.detector import FAMILY, V2XSimDetector, write_weights

__all__ = ["FAMILY", "V2XSimDetector", "write_weights"]
